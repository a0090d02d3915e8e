"""A step of a machine's model with another gap, dead zone or gains, by the exact simulation."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from servotwin.control.gains import gains_of, with_gains
from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.dashboard.map_position import CoarseMaps
from servotwin.dashboard.window_view import envelope_indices
from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains
from servotwin.messages.checks import InvalidMessage
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.margins import sensitivity_peak
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.plant.signals import Array, Step
from servotwin.simulation.run import Run
from servotwin.simulation.simulate import simulate
from servotwin.twin.model_registry import ServoModel

MAX_SAMPLES = 100_000
"""Of a simulated step."""
_SHOWN_S, _SHOWN_BANDWIDTHS, _LONGEST = 6.0, 60.0, 5.0
"""Time that is shown: the longer of so many of the machine's own seconds, as if it were the paper's, and of so many
times one over its bandwidth (rad/s); and how many times as long one may ask."""
_SAMPLES, _COLUMNS = 4000, 400
"""Samples of a continuous loop, and columns of the screen."""
_LARGEST_STEP = 10.0
"""Times the largest step that the twin's file states."""
_SETTLED = 0.02
"""Share of the step that counts as settled, where the dead zone is not wider."""
_REST = 0.25
"""Share of the run, at its end, in which the machine should be at rest."""


class WhatIf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Question of a client; what is absent is as in the twin's file.

    Attributes
    ----------
    gap : float
        rad, total.
    tolerance : float, optional
        m or rad, half-width of the dead zone; 0: none.
    k_dz : float, optional
        Half-width of the dead zone over the travel in the gap, in place of `tolerance`.
    gains : dict of str to float or bool
        Of the law that the machine has, by their names in messages.
    step : float, optional
        m or rad.
    duration : float, optional
        s.
    """

    gap: float
    tolerance: float | None = None
    k_dz: float | None = None
    gains: dict[str, bool | float] = {}
    step: float | None = None
    duration: float | None = None


def read_what_if(body: bytes) -> WhatIf:
    """Decode a question in JSON; raises InvalidInput."""
    try:
        asked = msgspec.json.decode(body, type=WhatIf)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the question cannot be read: {error}") from None
    if asked.tolerance is not None and asked.k_dz is not None:
        raise InvalidInput("tolerance and k_dz exclude each other: give one of them")
    return asked


def simulated_step(model: ServoModel, asked: WhatIf, maps: CoarseMaps | None = None) -> dict[str, Any]:
    """Simulate a step from rest, the load in the middle of its gap.

    Parameters
    ----------
    model : ServoModel
    asked : WhatIf
    maps : CoarseMaps, optional
        The answer then has the place in the stability map, as `CoarseMaps.position` gives it, under `map`.

    Returns
    -------
    dict
        Ready for JSON, SI units: gap, tolerance, k_dz, gains, step, duration as simulated; units of travel and command;
        time, position, reference and command, decimated to the least and greatest sample of each column of a screen;
        sensitivity_peak (Ms of the loop without a gap); overshoot (share of the step), settled (s; None: not within the
        run), last_error (greatest error in the last quarter) and last_motion (peak to peak in it).

    Raises
    ------
    InvalidInput
        A value is not allowed, or the loop is unstable even without a gap.
    """
    servo = model.servo
    law = _law(servo, asked)
    servo.check_loop(law)
    step, duration = _step(model, asked), _duration(servo, law, asked)
    tolerance = servo.tolerance_for(asked.gap, asked.k_dz) if asked.k_dz is not None else asked.tolerance or 0.0
    run = simulate(
        servo,
        duration,
        controller=law,
        reference=Step(step),
        gap=asked.gap,
        tolerance=tolerance or None,
        sample_rate=law.sample_rate or _SAMPLES / duration,
    )
    travel = servo.p * asked.gap
    return {
        "gap": asked.gap,
        "tolerance": tolerance,
        "k_dz": tolerance / travel if travel > 0.0 else None,
        "gains": msgspec.structs.asdict(gains_of(law)),
        "step": step,
        "duration": duration,
        "travel": servo.p,
        "travel_unit": position_unit(servo).si,
        "command_unit": command_unit(servo),
        "sensitivity_peak": _sensitivity_peak(servo, law),
        **_series(run),
        **_figures(run, step, tolerance),
        **({} if maps is None else {"map": maps.position(servo, law, asked.gap, tolerance, step)}),
    }


@lru_cache(maxsize=256)
def _sensitivity_peak(servo: Plant, law: AnyController) -> float:
    """Ms, remembered while only the gap or the dead zone is dragged."""
    changed = servo.replace(controller=law)
    if isinstance(law_of(law), LinearLaw):
        return float(changed.margins().Ms)
    return sensitivity_peak(changed.loop(), changed.closed_loop())


def _law(servo: Plant, asked: WhatIf) -> AnyController:
    own = gains_of(servo.controller)
    known = msgspec.structs.asdict(own)
    for name in asked.gains:
        if name not in known:
            raise InvalidInput(f"gains.{name}: this machine's law has {', '.join(known)}")
    if not asked.gains:
        return servo.controller
    try:
        gains: AnyGains = msgspec.convert({**known, **asked.gains}, type(own))
    except (msgspec.MsgspecError, InvalidMessage) as error:
        raise InvalidInput(str(error)) from None
    return with_gains(servo.controller, gains)


def _step(model: ServoModel, asked: WhatIf) -> float:
    largest = model.settings.uncertainty.step[1]
    if asked.step is None:
        return largest
    if not 0.0 < asked.step <= _LARGEST_STEP * largest:
        raise InvalidInput(f"step = {asked.step:g}: must be above 0 and at most {_LARGEST_STEP * largest:g}")
    return asked.step


def _duration(servo: Plant, law: AnyController, asked: WhatIf) -> float:
    shown = _shown(servo)
    longest = _LONGEST * shown
    if law.sample_rate is not None:
        longest = min(longest, (MAX_SAMPLES - 1) / law.sample_rate)
    if asked.duration is None:
        return min(shown, longest)
    if not 0.0 < asked.duration <= longest:
        raise InvalidInput(f"duration = {asked.duration:g} s: must be above 0 and at most {longest:g} s")
    return asked.duration


@lru_cache(maxsize=64)
def _shown(servo: Plant) -> float:
    """Time in which a step of the running loop has settled, s."""
    return max(_SHOWN_S * scales(servo).time, _SHOWN_BANDWIDTHS / servo.margins().bandwidth)


def _series(run: Run) -> dict[str, Any]:
    """The channels at the samples that a screen shows of the position and of the command."""
    position, command = run.position, run.voltage
    kept = sorted({k for values in (position, command) for k in envelope_indices(values.tolist(), _COLUMNS)})
    columns = {"time": run.time, "position": position, "reference": run.reference, "command": command}
    return {name: _short(values[kept]) for name, values in columns.items()}


def _short(values: Array) -> list[float]:
    """Seven digits: a screen shows no more."""
    size = np.abs(values)
    unit = 10.0 ** (6.0 - np.floor(np.log10(np.where((size > 1e-200) & (size < 1e200), size, 1.0))))
    return (np.round(values * unit) / unit).tolist()


def _figures(run: Run, step: float, tolerance: float) -> dict[str, float | None]:
    position = run.position
    error = np.abs(position - step)
    outside = np.flatnonzero(error > max(tolerance, _SETTLED * step))
    last = position[int((1.0 - _REST) * position.size) :]
    settled = outside.size == 0 or outside[-1] < (1.0 - _REST) * position.size
    return {
        "overshoot": max(0.0, float(position.max()) / step - 1.0),
        "settled": float(run.time[outside[-1] + 1]) if settled and outside.size else (0.0 if settled else None),
        "last_error": float(np.abs(last - step).max()),
        "last_motion": float(np.ptp(last)),
    }
