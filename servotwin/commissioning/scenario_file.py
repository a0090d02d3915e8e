"""A scenario for an axis that was identified: its twin verifies settings for what the recordings left uncertain."""

from __future__ import annotations

import math
from pathlib import Path

from servotwin.commissioning.commission import CommissionedAxis
from servotwin.config.toml import Values, dumps
from servotwin.errors import InvalidInput
from servotwin.plant.sensors import LOAD
from servotwin.redesign.certified.uncertainty import Uncertainty

_STEPS = (30.0, 100.0)  # amplitudes of the square wave, in gaps, that the twin's settings must settle
# Gap at the begin and at the end of the scenario, of the largest one: within a window a gap is one number, and one that
# grew tenfold in three cycles left 5 to 15 % of half of it unexplained.
_WEAR = (0.5, 1.0)
_CYCLES = 6
_LEAST_WINDOW = 500  # samples
# Of half a period: a motor that comes to rest without overshoot touches one flank in each step, so a window holds two.
_WINDOW, _BEFORE = 1.5, 0.95
_TIMES = 40.0  # time constants of the loop in half a period


def scenario_of(found: CommissionedAxis, axis_file: Path, largest_gap: float) -> str:
    """Text of a scenario in which the gap grows to the largest one (mm, of a rotary axis deg, at the load).

    Raises
    ------
    InvalidInput
        No axis, no encoder at its load, or a gap that is not positive.
    """
    axis = found.axis
    if axis is None or axis.sensors.feedback != LOAD:
        raise InvalidInput("--scenario: the twin needs an axis with an encoder at the load; give --feedback load")
    if not (math.isfinite(largest_gap) and largest_gap > 0.0):
        raise InvalidInput(f"--largest-gap {largest_gap!r}: must be positive and finite")
    rotary, known = found.logs[0].recording.rotary, found.uncertainty
    unit, per = ("deg", 180.0 / math.pi) if rotary else ("mm", 1e3)
    largest_gap = largest_gap / per
    amplitude = _STEPS[0] * largest_gap
    crossovers = axis.margins().gain_crossovers
    half = _TIMES / min(each.omega for each in crossovers) if crossovers else 1.0
    rate = float(axis.controller.sample_rate or 1.0)
    # Whole samples, and whole fifths of them.
    half = 20.0 * math.ceil(max(half * rate, _LEAST_WINDOW) / 20.0) / rate
    gaps = [math.degrees(share * largest_gap / axis.p) for share in _WEAR]
    bias = 0.5 * (known.input_bias[0] + known.input_bias[1])
    values: Values = {
        "servo": axis_file.name,
        "name": "commissioned",
        "duration_s": 2.0 * _CYCLES * half,
        "reference": {"kind": "square", f"amplitude_{unit}": per * amplitude, "period_s": 2.0 * half},
        "gap": {"from_deg": gaps[0], "to_deg": gaps[1], "over_s": 2.0 * _CYCLES * half},
        "disturbances": {"input_bias_n_m": bias},
        "recording": {"sample_rate_hz": rate, "window_s": _WINDOW * half, "pre_trigger_s": _BEFORE * half},
        "twin": {
            "policy": "certified",
            "uncertainty": {
                **({} if found.drive.split is None else _shaft(known)),
                "k_t_percent": 100.0 * known.k_T,
                "k_b_percent": 100.0 * known.k_B,
                "gap_deg": [0.0, 1.5 * gaps[1]],
                f"step_{unit}": [per * amplitude, 2.0 * per * _STEPS[1] * largest_gap],
                "friction_n_m": list(known.friction),
                "input_bias_n_m": list(known.input_bias),
            },
        },
    }
    return dumps(values)


def _shaft(known: Uncertainty) -> Values:
    """Half-widths of load, stiffness and damping, which a second encoder shows."""
    return {f"{name}_percent": 100.0 * float(getattr(known, name)) for name in ("m", "k", "c")}
