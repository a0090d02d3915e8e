"""Evidence on which a policy decides."""

from __future__ import annotations

from dataclasses import dataclass

from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.messages import Gains, Setting

NOT_OBSERVED = nothing_known(float("nan"), "not observed")


@dataclass(frozen=True)
class Evidence:
    """Estimate of one window, and what is known beside it.

    Attributes
    ----------
    estimate : GapEstimate
        Of the gap in the middle of the window.
    disturbance : Disturbance
        Input bias and noise in the same window.
    trend : Trend or None
        Gap and wear from all windows that counted, this one included.
    setting : Setting or None
        In force at the edge, as it last said; None: not known. Gains None: set by somebody else than this twin.
    tuned_for : float or None
        rad, gap of the last redesign; None before the first.
    why_not : str
        Why nothing may stand on the estimate: its status, or that it does not fit the trend; empty where it may.
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
        """Reason why nothing may stand on the estimate; empty where it may."""
        if self.why_not or self.estimate.ok:
            return self.why_not
        reasons = "; ".join(self.estimate.reasons)
        return f"the estimate is {self.estimate.status.value}" + (f": {reasons}" if reasons else "")
