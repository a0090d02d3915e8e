"""Policies that set the dead zone only: by the paper's remarks on noise and step sizes, and with hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from servotwin.control.gains import gains_of
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.messages import AnyGains, Setting
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.uncertainty import Range
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.redesign.settling import settling_map


def gap_range(estimate: GapEstimate) -> Range:
    """Range of possible gaps (rad): the estimate's interval, widened by its `std_total`."""
    spread = NORMAL_95 * estimate.std_total
    low, high = min(estimate.interval[0], estimate.gap - spread), max(estimate.interval[1], estimate.gap + spread)
    return max(low, 0.0), high


@dataclass(frozen=True)
class MarginPolicy:
    """tolerance = max(k_DZ p gap, k_noise noise) for the widest gap of the interval.

    k_DZ is the least one that settles for every step of the stated size, read from the map of `settling`. The rule
    follows the paper's remarks on k_DZ and on noise (sections 4.2 and 4.3).

    Parameters
    ----------
    servo : Servo or Axis
    step : (float, float)
        m, sizes of the steps that the reference makes.
    k_noise : float
        Tolerances per standard deviation of the measurement's noise.

    Raises
    ------
    InvalidInput
        A value is outside its range.
    """

    servo: Plant
    step: Range = (1e-4, 2.5e-3)
    k_noise: float = 3.0
    needs_estimate: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0.0 < self.step[0] <= self.step[1] < math.inf:
            raise InvalidInput(f"policy step = {self.step!r} m: must be positive, finite and in order")
        if not 0.0 <= self.k_noise < math.inf:
            raise InvalidInput(f"policy k_noise = {self.k_noise!r}: must be finite and at least 0")

    def redesign(self, evidence: Evidence) -> Redesign:
        """The tolerance for an estimate that is OK."""
        if evidence.unusable:
            return Redesign(None, math.nan, evidence.unusable)
        estimate = evidence.estimate
        high = gap_range(estimate)[1]
        noise = evidence.disturbance.noise
        least = self.k_noise * noise if math.isfinite(noise) else 0.0
        # Without lost motion the map, which is in units of it, does not apply.
        if high == 0.0:
            return Redesign(Setting(least), estimate.gap, "")
        lost = self.servo.p * high
        k_dz = settling_map(self.servo).least(self.step[0] / lost, self.step[1] / lost)
        if not math.isfinite(k_dz):
            return Redesign(None, math.nan, "no dead zone on the map settles for every step of the stated size")
        return Redesign(Setting(max(k_dz * lost, least)), estimate.gap, "")


@dataclass(frozen=True)
class HysteresisPolicy:
    """A dead zone of p gap with hysteresis: entered well inside of it, left well outside.

    Parameters
    ----------
    servo : Servo or Axis
    enter, leave : float
        Tolerances.
    """

    servo: Plant
    enter: float = 0.5
    leave: float = 1.5
    needs_estimate: ClassVar[bool] = True

    def redesign(self, evidence: Evidence) -> Redesign:
        """Tolerance and thresholds for an estimate that is OK; none where those in force fit it already."""
        if evidence.unusable:
            return Redesign(None, math.nan, evidence.unusable)
        estimate = evidence.estimate
        gains = gains_of(self.servo.controller.replace(enter=self.enter, leave=self.leave))
        if self._in_force(evidence, gains):
            return Redesign(None, estimate.gap, "the dead zone in force is that of a gap in the estimate's interval")
        return Redesign(Setting.of(self.servo.p * estimate.gap, gains), estimate.gap, "")

    def _in_force(self, evidence: Evidence, gains: AnyGains) -> bool:
        """True where the edge runs these gains, with a dead zone that the estimate does not tell from its own."""
        low, high = gap_range(evidence.estimate)
        now = evidence.setting
        return now is not None and now.gains == gains and self.servo.p * low <= now.tolerance <= self.servo.p * high
