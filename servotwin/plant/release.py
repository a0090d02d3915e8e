"""Time in which a machine's loop lets the offset of its command fade where nobody stated one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.plant.margins import Margins

_CROSSOVERS = 5.0  # over the crossover: the 0.5 s of the paper's loop, whose crossover is 10 rad/s

_Law = TypeVar("_Law", bound=AnyController)


def released(controller: _Law, margins: Callable[[], Margins]) -> _Law:
    """The controller with its `release_time`: as stated, otherwise that of the loop with these margins."""
    if controller.release_time is not None:
        return controller
    found = release_time(margins)
    return controller if found is None else controller.replace(release_time=found)  # type: ignore[return-value]


def release_time(margins: Callable[[], Margins]) -> float | None:
    """Five over the first gain crossover, s: slow enough that a change is no jerk, gone when the loop has settled.

    Without a crossover the bandwidth stands for it. None: the loop has neither, or cannot be computed.
    """
    try:
        with np.errstate(all="ignore"):
            found = margins()
    except (np.linalg.LinAlgError, OverflowError, InvalidInput):
        return None
    first = found.gain_crossovers[0].omega if found.gain_crossovers else found.bandwidth
    return _CROSSOVERS / first if 0.0 < first < math.inf else None
