"""Thinning of long logs: stretches at the full rate stay, and of what lies between them what a play remembers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_STRETCH, _LEAST, _STRETCHES = 1024, 16, 16  # samples of a stretch, at least, and stretches that must fit


class Thinned(NamedTuple):
    """Samples of a thinned log.

    Attributes
    ----------
    table : (n, c) array
    alone : (n,) bool array
        True for samples that stand between stretches, as turning points of the motor.
    """

    table: Array
    alone: np.ndarray[tuple[int], np.dtype[np.bool_]]


class Stretches:
    """Samples so far, at most so many; where there are more, every second stretch becomes its turning points.

    Parameters
    ----------
    most : int
        Samples to hold.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._length = max(_LEAST, min(_STRETCH, most // _STRETCHES))
        self._parts: list[Array] = []
        self._whole: list[bool] = []
        self._begun: list[Array] = []  # tables that do not fill a stretch yet
        self.dropped = 0

    def add(self, table: Array) -> None:
        """Add the next samples, (n, c); times in the first column, the motor in the second."""
        joined = np.concatenate([*self._begun, table])
        full = len(joined) // self._length
        for place in range(full):
            self._parts.append(joined[place * self._length : (place + 1) * self._length].copy())
            self._whole.append(True)
        self._begun = [joined[full * self._length :]]
        while sum(map(len, self._parts)) + len(self._begun[0]) > self._most:
            self._halve()

    def thinned(self) -> Thinned:
        """All samples that stayed."""
        parts, whole = [*self._parts, *self._begun], [*self._whole, *(True for _ in self._begun)]
        alone = np.repeat(np.logical_not(whole), list(map(len, parts))) if parts else np.zeros(0, dtype=np.bool_)
        return Thinned(np.concatenate(parts) if parts else np.empty((0, 0)), alone)

    def _halve(self) -> None:
        """Of two stretches keep the one in which the motor moves further, and join what lies between stretches."""
        before = sum(map(len, self._parts))
        stretches = [place for place, whole in enumerate(self._whole) if whole]
        for one, other in zip(stretches[::2], stretches[1::2], strict=False):
            less = one if np.ptp(self._parts[one][:, 1]) < np.ptp(self._parts[other][:, 1]) else other
            self._whole[less] = False
        parts: list[Array] = []
        whole: list[bool] = []
        between: list[Array] = []
        for part, kept in zip(self._parts, self._whole, strict=True):
            if not kept:
                between.append(part)
                continue
            parts += [remembered(np.concatenate(between)), part] if between else [part]
            whole += [False, True] if between else [True]
            between = []
        parts += [remembered(np.concatenate(between))] if between else []
        whole += [False] if between else []
        self._parts, self._whole = parts, whole
        self.dropped += before - sum(map(len, parts))


def remembered(table: Array) -> Array:
    """Rows of which a play with any gap keeps a memory: the extremes of the motor, and those behind them in turn.

    Later and larger motions wipe out what was before: of rows (n, c) with the motor in the second column the earlier
    of highest and lowest stays, the later one, the extreme of the other side behind that, and so on to the end.
    """
    motor = table[:, 1]
    high, low = int(np.argmax(motor)), int(np.argmin(motor))
    places, upper = [min(high, low)], high < low
    while places[-1] < motor.size - 1:
        begin = places[-1] + 1
        rest = motor[begin:]
        places.append(begin + int(np.argmin(rest) if upper else np.argmax(rest)))
        upper = not upper
    return table[places]
