"""The gap within a lost motion: what remains when the wind-up by friction is taken off."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus, Interval
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.models import ModelTrial, trials
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.travel import StatedTravel, check_travel, units_of
from servotwin.plant.axis import Axis
from servotwin.plant.display_units import position_unit
from servotwin.plant.plants import Plant

_DOUBT = 1.0  # of the wind-up: friction changes, and a load that swings leaves less of it
_SHARE = 0.5  # of the lost motion: a larger wind-up leaves no gap that is known
_UNKNOWN = (
    "two positions do not tell how much of the lost motion is wind-up by the load's friction: give the machine "
    "(--axis), or --stiff where nothing winds up"
)


@dataclass(frozen=True)
class TransmissionGap:
    """Gap of a transmission, in the units of the recording that shows its lost motion.

    Attributes
    ----------
    lost : LostMotion
    gap_motor, std_motor : float
        Total gap on the motor's side and its standard deviation, the motor's unit; NaN and inf where it is not known.
    interval_motor : (float, float)
        95 %; from 0 to the largest lost motion where the wind-up is not known.
    status : GapStatus
        LOST_MOTION: the lost motion is known, and how much of it is gap is not.
    reasons : tuple of str
    dynamics : ModelTrial or None
        The load's dynamics, where they were tried.
    """

    lost: LostMotion
    gap_motor: float
    std_motor: float
    interval_motor: Interval
    status: GapStatus
    reasons: tuple[str, ...] = ()
    dynamics: ModelTrial | None = None

    @property
    def trials(self) -> tuple[ModelTrial, ...]:
        """All models that were tried, from simple to rich, and one without a gap."""
        tried = () if self.dynamics is None else (self.dynamics,)
        return (*trials(self.lost.comparisons), *tried)

    @property
    def gap_load(self) -> float:
        return self.gap_motor * abs(self.lost.ratio)

    @property
    def std_load(self) -> float:
        return self.std_motor * abs(self.lost.ratio) * self.lost.load_spread

    @property
    def interval_load(self) -> Interval:
        gap = self.lost.at_motor if math.isnan(self.gap_motor) else self.gap_motor
        return self.lost.seen_at_load(gap, self.interval_motor)

    @property
    def ok(self) -> bool:
        return self.status is GapStatus.OK


def wind_up(machine: Plant) -> float:
    """Way of the motor (rad) by which the load's friction winds up the transmission between the two directions.

    Twice the Coulomb friction over the stiffness, seen at the motor; 0 for the paper's servo, whose load has none.
    """
    if not isinstance(machine, Axis) or math.isinf(machine.transmission.k_d):
        return 0.0
    return 2.0 * machine.guide.friction / machine.transmission.k_d / machine.p


def gap_within(lost: LostMotion, off: float | None, unit: str = "") -> TransmissionGap:
    """Take a wind-up off a lost motion; the one place that decides if a log shows a gap.

    Two positions do not tell how much of a lost motion is a gap: at a reversal the load sticks while the transmission
    unwinds and winds up again. A wind-up that is given counts as known within a factor of 0 to 2.

    Parameters
    ----------
    lost : LostMotion
    off : float or None
        Wind-up, the motor's unit: 0 for a stiff transmission; None where it is not known.
    unit : str
        The motor's, for the reasons.
    """
    low, high = lost.interval_motor
    if lost.interval_motor == NOTHING_KNOWN:
        return TransmissionGap(lost, math.nan, math.inf, NOTHING_KNOWN, lost.status, lost.reasons)
    if off is None:
        status = GapStatus.LOST_MOTION if lost.ok else lost.status
        reasons = lost.reasons if status is GapStatus.UNIDENTIFIABLE else (*lost.reasons, _UNKNOWN)
        return TransmissionGap(lost, math.nan, math.inf, (0.0, high), status, reasons)
    if not off:
        return TransmissionGap(lost, lost.at_motor, lost.std_motor, lost.interval_motor, lost.status, lost.reasons)
    reason = f"{off:.4g} {unit} of the lost motion of {lost.at_motor:.4g} {unit} are wind-up by the load's friction"
    interval = (max(low - 2.0 * _DOUBT * off, 0.0), high)
    if math.isfinite(high):
        half, middle = math.hypot(0.5 * (high - low), _DOUBT * off), 0.5 * (low + high) - off
        interval = (max(middle - half, 0.0), max(middle + half, 0.0))
    large = off > _SHARE * lost.at_motor
    return TransmissionGap(
        lost,
        gap_motor=max(lost.at_motor - off, 0.0),
        std_motor=math.hypot(lost.std_motor, 0.5 * _DOUBT * off),
        interval_motor=interval,
        status=GapStatus.UNIDENTIFIABLE if large and lost.ok else lost.status,
        reasons=(*lost.reasons, reason),
    )


def gap_of_machine(recording: EncoderRecording, lost: LostMotion, machine: Plant) -> TransmissionGap:
    """Take a machine's wind-up off the lost motion that a recording shows.

    Raises
    ------
    InvalidInput
        Units that are not known, or a ratio that is not the machine's.
    """
    if lost.interval_motor == NOTHING_KNOWN:
        return gap_within(lost, None)
    travel = travel_of_machine(machine)
    check_travel(recording, lost, travel)
    off = wind_up(machine) / units_of(recording, travel)[0]
    return gap_within(lost, off, recording.motor_unit)


def travel_of_machine(machine: Plant) -> StatedTravel:
    return StatedTravel(machine.p, position_unit(machine).si == "rad", "--axis")
