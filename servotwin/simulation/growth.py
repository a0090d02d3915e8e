"""Runs of loops that grow without bound: such a run ends with what is wrong with the loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servotwin.control.laws import Law
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.plants import Plant


class UnstableLoop(InvalidInput, ZenoError):
    """A loop whose motion grew without bound; a `ZenoError` too, since its contacts are lost in rounding on the way."""


def advance_bounded(servo: Plant, law: Law, advance: Callable[[], None], state: Callable[[], Array]) -> None:
    """Advance a run that must stay within what can be computed.

    Parameters
    ----------
    servo : Servo or Axis
    law : Controller or LinearLaw
        The one that runs.
    advance : callable
        Advances the run.
    state : callable
        The run's states after that.

    Raises
    ------
    UnstableLoop
        The loop is unstable, and gap and friction are smaller than the rounding of its states; or a state is no number.
    ZenoError
        Modes change without end in another loop.
    """
    try:
        advance()
    except ZenoError as error:
        if why := _instability(servo, law):
            raise UnstableLoop(_sentence(why)) from error
        raise
    if not np.all(np.isfinite(state())):
        raise UnstableLoop(_sentence(_instability(servo, law)))


def _sentence(why: str) -> str:
    grows = "the loop is unstable: its motion grows without bound, until it is too large to be computed"
    return f"{grows}; {why}" if why else grows


def _instability(servo: Plant, law: Law) -> str:
    """Reason for which the loop is unstable without a gap; empty where it is not."""
    try:
        servo.check_loop(law)
    except InvalidInput as error:
        return str(error)
    return ""
