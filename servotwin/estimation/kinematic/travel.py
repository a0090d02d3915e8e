"""Travel of the load per angle of the motor, as the user states it: it checks units, or gives the load one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.recording import EncoderRecording

ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": math.pi / 180.0,
    "°": math.pi / 180.0,
    "rev": 2.0 * math.pi,
    "arcmin": math.pi / 10_800.0,
    "arcsec": math.pi / 648_000.0,
}
"""Radians per unit."""
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "cm": 1e-2, "in": 0.0254}
"""Metres per unit."""
# By how much the recording's load per motor may differ from what is stated; where the load swings it is not well known.
_RATIO, _RATIO_OF_SWINGING = 0.05, 0.25


class StatedTravel(NamedTuple):
    """Travel of the load per radian of the motor, m, of a rotary load rad.

    Attributes
    ----------
    per_radian : float
    rotary : bool
    said : str
        Who states it, for messages: --axis, --ratio ...
    """

    per_radian: float
    rotary: bool
    said: str

    @property
    def units(self) -> dict[str, float]:
        """Units that the load may have, in SI units."""
        return ANGLES if self.rotary else LENGTHS


def stated_travel(lead_mm: float | None, ratio: float | None) -> StatedTravel | None:
    """Travel by a lead (mm per turn of the motor) or a gear ratio; None: neither is given.

    Raises
    ------
    InvalidInput
        Both are given, or a value is not positive.
    """
    if lead_mm is not None and ratio is not None:
        raise InvalidInput(f"--lead-mm {lead_mm:g} and --ratio {ratio:g}: give one of the two")
    for name, value in (("--lead-mm", lead_mm), ("--ratio", ratio)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise InvalidInput(f"{name} {value!r}: must be positive and finite")
    if lead_mm is not None:
        return StatedTravel(lead_mm * 1e-3 / (2.0 * math.pi), False, "--lead-mm")
    return None if ratio is None else StatedTravel(1.0 / ratio, True, "--ratio")


def check_travel(recording: EncoderRecording, lost: LostMotion, travel: StatedTravel) -> None:
    """Refuse a recording whose load moves otherwise than is stated.

    Raises
    ------
    InvalidInput
        Units that are not known, or another ratio.
    """
    motor_unit, load_unit = units_of(recording, travel)
    ratio = abs(lost.ratio) * load_unit / motor_unit
    if abs(ratio / travel.per_radian - 1.0) > (_RATIO if lost.ok else _RATIO_OF_SWINGING):
        raise InvalidInput(
            f"{recording.source}: its load moves by {ratio:.4g} per rad of the motor, in SI units, and that of "
            f"{travel.said} by {travel.per_radian:.4g}: check the units of both columns (--motor-unit, --load-unit) "
            f"and {travel.said}"
        )


def units_of(recording: EncoderRecording, travel: StatedTravel) -> tuple[float, float]:
    """SI units in one unit of the motor and of the load.

    Raises
    ------
    InvalidInput
        A unit that is not known.
    """
    for part, unit, known in (("motor", recording.motor_unit, ANGLES), ("load", recording.load_unit, travel.units)):
        if unit not in known:
            raise InvalidInput(
                f"{recording.source}: {part} in {unit!r}: with {travel.said} give --{part}-unit, one of "
                f"{', '.join(known)}; of counts, leave {travel.said} out: the travel per count is fitted"
            )
    return ANGLES[recording.motor_unit], travel.units[recording.load_unit]


def in_stated_unit(
    recording: EncoderRecording, lost: LostMotion, travel: StatedTravel
) -> tuple[EncoderRecording, LostMotion]:
    """Recording and lost motion with the load in a unit that the stated travel gives; one that has a unit is checked.

    Of a rotary load it is the motor's unit, of a linear one mm.

    Raises
    ------
    InvalidInput
        As `check_travel`.
    """
    if not math.isfinite(lost.ratio):
        return recording, lost
    if recording.load_unit in (*ANGLES, *LENGTHS):
        check_travel(recording, lost, travel)
        return recording, lost
    unit = recording.motor_unit if travel.rotary else "mm"
    motor_unit, load_unit = units_of(replace(recording, load_unit=unit), travel)
    scale = travel.per_radian * motor_unit / load_unit / abs(lost.ratio)
    count = None if recording.load_count is None else scale * recording.load_count
    scaled = replace(recording, load=scale * recording.load, load_unit=unit, load_count=count)
    return scaled, lost.with_load_times(scale)
