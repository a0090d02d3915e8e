"""Wind-up of a known machine: by how much the friction of its load makes the lost motion larger than the gap."""

from __future__ import annotations

import math
from dataclasses import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.shown import position_unit

_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "°": math.pi / 180.0, "rev": 2.0 * math.pi}
_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
_RATIO = 0.05  # by which the recording's load per motor may differ from the machine's
_DOUBT = 1.0  # of the wind-up: friction changes, and a load that swings leaves less of it
_SHARE = 0.5  # of the lost motion: a larger wind-up leaves no gap that is known


def wind_up(machine: Plant) -> float:
    """Way of the motor (rad) by which the load's friction winds up the transmission between the two directions.

    Twice the Coulomb friction over the stiffness, seen at the motor; 0 for the paper's servo, whose load has none.
    """
    if not isinstance(machine, Axis) or math.isinf(machine.transmission.k_d):
        return 0.0
    return 2.0 * machine.guide.friction / machine.transmission.k_d / machine.p


def with_machine(recording: EncoderRecording, found: LostMotion, machine: Plant) -> LostMotion:
    """Take a machine's wind-up off the lost motion that a recording shows.

    Two positions do not tell how much of a lost motion is a gap: at a reversal the load sticks while the transmission
    unwinds and winds up again. The friction counts as known within a factor of 0 to 2.

    Raises
    ------
    InvalidInput
        Units that are not known, or a ratio that is not the machine's.
    """
    if found.interval_motor == NOTHING_KNOWN or not math.isfinite(found.ratio):
        return found
    motor_unit, load_unit = _units(recording, machine)
    ratio = abs(found.ratio) * load_unit / motor_unit
    if abs(ratio / machine.p - 1.0) > _RATIO:
        raise InvalidInput(
            f"{recording.source}: its load moves by {ratio:.4g} per rad of the motor, in SI units, and that of --axis "
            f"by {machine.p:.4g}: check the units of both columns (--motor-unit, --load-unit) and the axis"
        )
    off, unit = wind_up(machine) / motor_unit, recording.motor_unit
    if not off:
        return found
    half = math.hypot(0.5 * (found.interval_motor[1] - found.interval_motor[0]), _DOUBT * off)
    middle = 0.5 * (found.interval_motor[0] + found.interval_motor[1]) - off
    reason = f"{off:.4g} {unit} of the lost motion of {found.gap_motor:.4g} {unit} are wind-up by the load's friction"
    large = off > _SHARE * found.gap_motor
    return replace(
        found,
        gap_motor=max(found.gap_motor - off, 0.0),
        std_motor=math.hypot(found.std_motor, 0.5 * _DOUBT * off),
        interval_motor=(max(middle - half, 0.0), max(middle + half, 0.0)),
        status=GapStatus.UNIDENTIFIABLE if large and found.ok else found.status,
        reasons=(*found.reasons, reason),
        model=f"{found.model}, wind-up of the axis",
    )


def _units(recording: EncoderRecording, machine: Plant) -> tuple[float, float]:
    """SI units in one unit of the motor and of the load."""
    loads = _ANGLES if position_unit(machine).si == "rad" else _LENGTHS
    for part, unit, known in (("motor", recording.motor_unit, _ANGLES), ("load", recording.load_unit, loads)):
        if unit not in known:
            raise InvalidInput(
                f"{recording.source}: {part} in {unit!r}: with --axis give --{part}-unit, one of {', '.join(known)}"
            )
    return _ANGLES[recording.motor_unit], loads[recording.load_unit]
