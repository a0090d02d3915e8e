"""Evidence for the decision of a policy."""

from __future__ import annotations

from dataclasses import dataclass

from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.messages import Gains, Setting

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
    """

    estimate: GapEstimate
    disturbance: Disturbance = NOT_OBSERVED
    trend: Trend | None = None
    setting: Setting | None = None
    tuned_for: float | None = None
    why_not: str = ""

    @property
    def gains(self) -> Gains | None:
        """Gains in force; None: not known."""
        return None if self.setting is None else self.setting.gains

    @property
    def unusable(self) -> str:
        """Reason against using the estimate; empty where it may be used."""
        if self.why_not or self.estimate.ok:
            return self.why_not
        reasons = "; ".join(self.estimate.reasons)
        return f"the estimate is {self.estimate.status.value}" + (f": {reasons}" if reasons else "")
