"""Advice to an engineer where a machine's windows do not tell the gap from the transmission's ratio. Pure."""

from __future__ import annotations

from msgspec import Struct
from msgspec.structs import replace

from servotwin.estimation.estimate import GapEstimate, UnknownRatio
from servotwin.redesign.excitation import ExcitationSettings

NO_REQUESTS = "the twin may request no moves ([twin.excitation] is absent)"
"""Reason of a twin that requests nothing."""


class UntoldRatio(Struct, frozen=True):
    """Part of the twin's state that belongs to windows that do not tell the gap from the ratio.

    Attributes
    ----------
    windows : int
        Number of these since the last window that told the ratio.
    advised : bool
        True once an alarm has said what to do.
    """

    windows: int = 0
    advised: bool = False

    def after(self, estimate: GapEstimate, prevented: str, settings: ExcitationSettings) -> tuple[UntoldRatio, str]:
        """Return the state after an estimate, and the sentence of the alarm; empty: none.

        `prevented`: why no moves of different lengths will be requested; empty: they are, or will be. The alarm comes
        after as many windows as a request would.
        """
        if estimate.ok and estimate.machine is not None:
            return UntoldRatio(), ""
        if estimate.ratio is None:
            return self, ""
        windows = self.windows + 1
        if self.advised or not prevented or windows < settings.after:
            return replace(self, windows=windows), ""
        return UntoldRatio(windows, advised=True), advice(estimate.ratio, prevented)


def advice(ratio: UnknownRatio, prevented: str) -> str:
    """Sentence that says what tells the ratio, and why the twin does not request it."""
    return (
        "the windows do not tell the gap from the transmission's ratio: move by different lengths once, or state the "
        f"ratio to {100.0 * ratio.needed:.2g} % (pitch_percent of [twin.learning]); {prevented}"
    )
