"""Sentences for the operator on a machine that is not what it was or what is stated of it."""

from __future__ import annotations

import math

from servotwin.control.controller import Controller
from servotwin.control.gains import with_gains
from servotwin.estimation.controller import compare_controller
from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import Setting
from servotwin.twin.estimating import DecodedWindow, Wear
from servotwin.twin.settings import TwinSettings

OTHER_CONTROLLER = 2
"""Windows in a row under another controller than stated that raise an alarm: a change of setting may lie in one."""


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


def windows_of_other_controller(
    controller: Controller | None, stated: Setting | None, decoded: DecodedWindow, before: int
) -> tuple[int, str]:
    """Count the windows in a row whose voltage is not that of the controller stated for them.

    Parameters
    ----------
    controller : Controller or None
        The servo's, with its limits, filters and rates; None: not known.
    stated : Setting or None
        In force when the window was cut; None: not known.
    decoded : DecodedWindow
    before : int
        The count before this window, which stays where the window does not tell.

    Returns
    -------
    count, sentence : int, str
        And what is wrong with this window's voltage; empty: nothing, or the window does not tell.
    """
    if controller is None or stated is None or decoded.window is None:
        return before, ""
    made = compare_controller(decoded.window, with_gains(controller, stated.gains), stated.tolerance)
    if made is None:
        return before, ""
    return (0, "") if made.agrees else (before + 1, made.sentence)
