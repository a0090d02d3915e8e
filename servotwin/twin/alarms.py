"""Sentences for the operator on a machine that is not what it was or what is stated of it."""

from __future__ import annotations

import math

from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.learning.wear import Wear
from servotwin.twin.settings import TwinSettings


def alarms(settings: TwinSettings, before: Wear, after: Wear, estimate: GapEstimate) -> list[str]:
    """List what an operator should know of the machine after a window, besides what was learnt."""
    sentences, count = list[str](), settings.learning.restart_after
    if after.mismatches == count > before.mismatches and after.machine == before.machine:
        because = "; ".join(estimate.reasons)
        sentences.append(
            f"{count} windows in a row fit no machine within what is known of this one ({because}): check the "
            "nameplate (stiffness, damping, pitch, masses), the channels' units, and what may be loose"
        )
    trend, earlier = after.trend(settings.trend), before.trend(settings.trend)
    if trend is not None and earlier is not None and trend.afresh and not earlier.afresh:
        sentences.append(
            f"the gap has jumped from {math.degrees(earlier.gap):.3g} to {math.degrees(trend.gap):.3g} deg, as after a "
            "crash, a repair or a new screw: it is followed from there"
        )
    return sentences
