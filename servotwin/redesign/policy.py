"""Protocol of the policies, the evidence on which they decide, and the paper's policy (Eq 21)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import AnyGains, Setting
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.last_search import LastSearch
from servotwin.redesign.certified.uncertainty import Region

NOT_OBSERVED = nothing_known(float("nan"), "not observed")


@dataclass(frozen=True)
class Evidence:
    """Estimate of one window, with the disturbance, the trend and the setting in force.

    Attributes
    ----------
    estimate : GapEstimate
        Of the gap in the middle of the window.
    disturbance : Disturbance
        Input bias and noise in the same window.
    trend : Trend or None
        Gap and wear from all accepted windows, this one included.
    setting : Setting or None
        In force at the edge by its last report; None: not known. Gains None: not set by this twin.
    tuned_for : float or None
        rad, gap of the last redesign; None before the first.
    why_not : str
        Reason against using the estimate, such as that it does not fit the trend; empty where it may be used.
    machine : FactorPrior or None
        The machine's numbers over the model's, as learnt from the windows; None: the model is all that is known.
    motor : LearntMotor or None
        The motor's numbers, friction and input bias, as learnt from the windows.
    rests : tuple of float
        V, input biases that the last windows before this one showed.
    steps : tuple of float
        m, sizes of the steps in the last windows, this one included.
    search : LastSearch or None
        The last search for a verified setting.
    """

    estimate: GapEstimate
    disturbance: Disturbance = NOT_OBSERVED
    trend: Trend | None = None
    setting: Setting | None = None
    tuned_for: float | None = None
    why_not: str = ""
    machine: FactorPrior | None = None
    motor: LearntMotor | None = None
    rests: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    search: LastSearch | None = None

    @property
    def gains(self) -> AnyGains | None:
        """Gains in force; None: not known."""
        return None if self.setting is None else self.setting.gains

    @property
    def unusable(self) -> str:
        """Reason against using the estimate; empty where it may be used."""
        if self.why_not or self.estimate.ok:
            return self.why_not
        reasons = "; ".join(self.estimate.reasons)
        return f"the estimate is {self.estimate.status.value}" + (f": {reasons}" if reasons else "")


@dataclass(frozen=True)
class Redesign:
    """Decision of a policy.

    Attributes
    ----------
    setting : Setting or None
        Dead zone, gains and predicted band; gains None: the gains stay. None: leave the controller as it is.
    gap : float
        Total gap, rad, that the setting was made for; NaN without one.
    reason : str
        Reason to leave the controller as it is, or to send the fallback set; empty otherwise.
    certificate : Certificate, optional
        Results of the setting in simulation.
    to_verify : Region, optional
        Region for which the setting is still to be verified, since its certificate is that of a wider one; None: none.
    search : LastSearch, optional
        Search that was made, to be remembered; None: none was.
    """

    setting: Setting | None
    gap: float
    reason: str
    certificate: Certificate | None = None
    to_verify: Region | None = None
    search: LastSearch | None = None


class Policy(Protocol):
    """Rule that makes a setting from evidence.

    Attributes
    ----------
    needs_estimate : bool
        True when the policy decides only on usable estimates.
    """

    @property
    def needs_estimate(self) -> bool: ...

    def redesign(self, evidence: Evidence) -> Redesign:
        """Decide on the evidence of one window."""
        ...


@dataclass(frozen=True)
class PaperPolicy:
    """tolerance = k_dz p gap, from usable estimates only.

    Parameters
    ----------
    servo : Servo or Axis
        For its pitch.
    k_dz : float
        Tolerances per gap (the paper's is one).
    smoothing : float
        Share of the previous gap in each update, 0 (none: Eq 21 as printed) up to, but not including, 1.
        The paper's "l = 1/10" may mean this; it is not explained there (erratum E14).

    Raises
    ------
    InvalidInput
        A value is outside its range.
    """

    servo: Plant
    k_dz: float = 1.0
    smoothing: float = 0.0
    needs_estimate: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.k_dz) and self.k_dz >= 0.0):
            raise InvalidInput(f"policy k_dz = {self.k_dz!r}: must be finite and at least 0")
        if not 0.0 <= self.smoothing < 1.0:
            raise InvalidInput(f"policy smoothing = {self.smoothing!r}: must be at least 0 and below 1")

    def redesign(self, evidence: Evidence) -> Redesign:
        """Set the tolerance for an estimate; smoothed only where an earlier redesign had a gap."""
        if evidence.unusable:
            return Redesign(None, math.nan, evidence.unusable)
        share = self.smoothing if evidence.tuned_for is not None else 0.0
        gap = (1.0 - share) * evidence.estimate.gap + share * (evidence.tuned_for or 0.0)
        return Redesign(Setting(self.k_dz * self.servo.p * gap), gap, "")
