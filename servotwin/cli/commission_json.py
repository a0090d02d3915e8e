"""JSON object of `servotwin commission`, and the units of its numbers."""

from __future__ import annotations

import math
from typing import Any

from servotwin.commissioning.commission import CommissionedAxis
from servotwin.estimation.inverse_dynamics.closed_loop import FittedLaw
from servotwin.estimation.inverse_dynamics.fit import ParameterFit
from servotwin.estimation.inverse_dynamics.fitted_pid import FittedPid
from servotwin.estimation.kinematic.wind_up import gap_within
from servotwin.logs.drive_recordings import DriveLog

WORDS = {
    "inertia": "inertia",
    "viscous": "viscous friction",
    "coulomb": "Coulomb friction",
    "offset": "offset",
    "viscous_forward": "viscous, forwards",
    "coulomb_forward": "Coulomb, forwards",
    "viscous_backward": "viscous, backwards",
    "coulomb_backward": "Coulomb, backwards",
}
"""Names of the fitted numbers, as tables show them."""


def units_of(found: CommissionedAxis) -> dict[str, str]:
    recording = found.logs[0].recording
    force, position = recording.force_unit, recording.unit
    viscous = "N m s/rad" if found.force_per_command is not None and recording.rotary else f"{force} s/{position}"
    inertia = recording.inertia_unit
    return {
        name: inertia if name == "inertia" else viscous if name.startswith("viscous") else force for name in (*WORDS,)
    }


def _law_dict(law: FittedLaw | None) -> dict[str, Any] | None:
    if law is None:
        return None
    if isinstance(law, FittedPid):
        return {"kind": "pid", "kp": law.Kp, "ki": law.Ki, "kd": law.Kd, "filter_time_s": law.Tf}
    return {
        "kind": "cascade",
        "position_gain_per_s": law.position_gain,
        "velocity_gain": law.velocity_gain,
        "integral_time_s": law.integral_time,
        "speed_filter_s": law.speed_filter,
    }


def _shaft_dict(found: CommissionedAxis) -> dict[str, Any] | None:
    shaft, split = found.drive.shaft, found.drive.split
    if shaft is None:
        return None

    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None

    load = math.nan if split is None else split["load_inertia"]
    return {
        "resonance_hz": number(shaft.resonance),
        "resonance_std_hz": number(shaft.resonance_std),
        "damping_ratio": number(shaft.damping),
        "delay_s": number(shaft.delay),
        "delay_std_s": number(shaft.delay_std),
        "coherent_up_to_hz": shaft.highest,
        "load_inertia": number(load),
        "motor_inertia": None if split is None else split["motor_inertia"],
        "stiffness": number(shaft.stiffness(load)),
        "damping": number(shaft.shaft_damping(load)),
    }


def _gap_dict(log: DriveLog) -> dict[str, Any] | None:
    if log.lost_motion is None:
        return None
    found = gap_within(log.lost_motion, None)
    lost = found.lost
    known = all(map(math.isfinite, (lost.at_load, *lost.interval_load)))
    return {
        "status": found.status.value,
        "lost_motion_load": lost.at_load if known else None,
        "lost_motion_interval_load": list(lost.interval_load) if known else None,
        "interval_load": list(found.interval_load) if known else None,
        "unit": log.recording.unit,
    }


def as_dict(found: CommissionedAxis) -> dict[str, Any]:
    """Make the JSON object; null where there is no number."""
    drive, units = found.drive, units_of(found)
    refined = drive.refinement

    def fit(each: ParameterFit) -> dict[str, Any]:
        parameters = {
            name: {
                "value": each[name],
                "std": each.std(name),
                "half_width_95": each.half_width(name),
                "unit": units[name],
            }
            for name in each.names
        }
        shared = {"relative_error": each.relative_error, "condition": each.condition}
        return {"parameters": parameters, **shared}

    return {
        "logs": [log.recording.source.removeprefix("log ") for log in found.logs],
        "corner_hz": [band.corner for band in drive.bands],
        "inverse_dynamics": {"symmetric": fit(drive.symmetric), "asymmetric": fit(drive.asymmetric)},
        "simulated_loop": None
        if refined is None
        else {
            "symmetric": fit(refined.symmetric),
            "asymmetric": fit(refined.asymmetric),
            "position_error": refined.simulated.position_error,
            "force_error": refined.simulated.force_error,
            "converged": refined.converged,
        },
        "friction": [
            {"speed": each.speed, "value": each.force, "half_width_95": each.half_width, "unit": units["coulomb"]}
            for each in drive.friction
        ],
        "controller": _law_dict(drive.law),
        "shaft": _shaft_dict(found),
        "gap": _gap_dict(found.logs[0]),
        "force_per_command": found.force_per_command,
        "doubts": list(drive.doubts),
        "late": drive.late or None,
        "elastic": drive.elastic or None,
        "slip": drive.slip or None,
        "tight_spot": drive.tight or None,
        "unmodelled": drive.beside or None,
        "next_experiment": str(drive.advice),
    }
