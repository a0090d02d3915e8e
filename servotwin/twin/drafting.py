"""An update as it is made of a window; version and base come later."""

from __future__ import annotations

from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import Update, Window, finite
from servotwin.redesign.policy import Redesign
from servotwin.twin.proof import verification_of


def draft(message: Window, estimate: GapEstimate, redesign: Redesign, validity: float) -> Update:
    """An update but for its version and base.

    Parameters
    ----------
    message : messages.Window
        What it stands on.
    estimate : GapEstimate
    redesign : Redesign
        With a setting.
    validity : float
        s after the window's first sample for which it may still be applied.
    """
    assert redesign.setting is not None
    low, high = estimate.interval
    return Update(
        servo=message.servo,
        version=1,
        base_version=0,
        window=(message.boot, message.sequence),
        data_time=message.start,
        gap=finite(estimate.gap),
        std=finite(estimate.std_total),
        interval=(finite(low), finite(high)),
        status=estimate.status.value,
        setting=redesign.setting,
        not_after=message.start + validity,
        verification=None if redesign.certificate is None else verification_of(redesign.certificate),
    )
