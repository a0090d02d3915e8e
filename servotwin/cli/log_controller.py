"""Remarks of `servotwin identify` on the controller: from which window on the command follows another law."""

from __future__ import annotations

from collections.abc import Sequence

from servotwin.control.laws import AnyController
from servotwin.estimation.controller import TOLERATED, ControllerComparison, compare_controller
from servotwin.estimation.window import Window
from servotwin.twin.estimating import OTHER_CONTROLLER

_TIMES, _LEAST = 5.0, 0.03  # of the share of the command that was unexplained before; of the command's swing


def controller_remarks(windows: Sequence[Window], controller: AnyController) -> tuple[tuple[str, ...], ...]:
    """List, for each window, the sentence on a law that begins there, if any.

    The stated law must have explained the windows before: a log does not say its dead zone, so that one that never
    follows the law may well be under it.
    """
    remarks = [tuple[str, ...]() for _ in windows]
    compared = ((i, compare_controller(window, controller, 0.0)) for i, window in enumerate(windows))
    told = [(i, made) for i, made in compared if made is not None]
    usual = 0.0
    for k, (i, made) in enumerate(told):
        after = [each for _, each in told[k : k + OTHER_CONTROLLER]]
        enough = min(k, len(after)) >= OTHER_CONTROLLER
        if enough and all(_unexplained(each) > _limit(each, usual) for each in after):
            remarks[i] = (_sentence(made, usual),)
            break
        usual = max(usual, _unexplained(made))
        if usual > TOLERATED:
            break
    return tuple(remarks)


def _unexplained(made: ControllerComparison) -> float:
    """Share of the command's swing."""
    return made.unexplained / made.swing if made.swing > 0.0 else float(not made.agrees)


def _limit(made: ControllerComparison, usual: float) -> float:
    """Share that is no other law, beside what was usual: noise and rounding give the rest of what is tolerated."""
    noise = made.tolerated / made.swing - TOLERATED if made.swing > 0.0 else 0.0
    return max(_TIMES * usual, _LEAST) + noise


def _sentence(made: ControllerComparison, usual: float) -> str:
    fitting = ", ".join(f"{name} {factor:.2g}" for name, factor in made.factors.items())
    like = f"; it fits {fitting} times the stated" if fitting else ""
    left = f"{100.0 * _unexplained(made):.2g} % of its swing unexplained, and {100.0 * usual:.1f} % before"
    return f"from here on the command follows another law than the stated one, which leaves {left}{like}"
