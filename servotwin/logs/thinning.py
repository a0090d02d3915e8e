"""Thinning of long logs: stretches at the full rate stay, and of what lies between them what a play remembers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_STRETCH, _LEAST, _STRETCHES = 32_768, 16, 16  # samples of a stretch, at least, and stretches that must fit

_RESTS = 0.01  # of the way in another stretch
_SEED = 14


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
    """Samples so far, at most so many; where there are more, fewer stretches stay, as densely everywhere in the log.

    Which of neighbouring stretches stays is drawn, lest it goes with the machine's cycle; one at rest makes way for one
    that moves.

    Parameters
    ----------
    most : int
        Samples to hold.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._length = max(_LEAST, min(_STRETCH, most // _STRETCHES))
        self._parts: list[_Stretch] = []
        self._begun: list[Array] = []  # tables that do not fill a stretch yet
        self._every = 1  # of so many stretches one stays
        self._group = 0  # stretches of which the last one that stays was chosen
        self._random = np.random.default_rng(_SEED)
        self.dropped = 0

    def add(self, table: Array) -> None:
        """Add the next samples, (n, c); times in the first column, the motor in the second."""
        joined = np.concatenate([*self._begun, table])
        full = len(joined) // self._length * self._length
        for begin in range(0, full, self._length):
            self._take(_Stretch(joined[begin : begin + self._length].copy(), True))
        self._begun = [joined[full:]]
        while self._held() > self._most:
            self._halve()

    def thinned(self) -> Thinned:
        """All samples that stayed."""
        parts = [*self._parts, *(_Stretch(table, True) for table in self._begun if len(table))]
        if not parts:
            return Thinned(np.empty((0, 0)), np.zeros(0, dtype=np.bool_))
        alone = np.repeat([not part.whole for part in parts], [len(part.table) for part in parts])
        return Thinned(np.concatenate([part.table for part in parts]), alone)

    def _held(self) -> int:
        return sum(len(part.table) for part in self._parts) + sum(map(len, self._begun))

    def _take(self, part: _Stretch) -> None:
        """Append the next stretch, or choose between it and the one that stays of its group so far."""
        if self._group == 0:
            self._parts.append(part)
        else:
            place = next(i for i in reversed(range(len(self._parts))) if self._parts[i].whole)
            kept = self._parts[place]
            if self._replaces(kept, part, 1.0 / (self._group + 1)):
                self._parts[place], last = kept._replace(whole=False), [part]
            else:
                last = [part._replace(whole=False)]
            self._append_joined([*self._cut_alone(), *last])
        self._group = (self._group + 1) % self._every

    def _replaces(self, kept: _Stretch, other: _Stretch, chance: float) -> bool:
        """True where another stretch is to stay in place of one."""
        drawn = bool(self._random.random() < chance)
        if min(kept.way, other.way) > _RESTS * max(kept.way, other.way):
            return drawn
        return other.way > kept.way

    def _cut_alone(self) -> list[_Stretch]:
        """Take away the parts at the end that are not whole."""
        place = len(self._parts)
        while place and not self._parts[place - 1].whole:
            place -= 1
        cut, self._parts = self._parts[place:], self._parts[:place]
        return cut

    def _append_joined(self, parts: list[_Stretch]) -> None:
        """Append parts, of neighbours that are not whole only the play extremes."""
        for part in parts:
            if not part.whole:
                before = self._cut_alone()
                joined = np.concatenate([*(each.table for each in before), part.table])
                part = _Stretch(play_extremes(joined), False)
                self.dropped += len(joined) - len(part.table)
            self._parts.append(part)

    def _halve(self) -> None:
        """Keep one of two stretches."""
        parts = self._parts
        places = [place for place, part in enumerate(parts) if part.whole]
        open_group = len(places) % 2
        for one, other in zip(places[::2], places[1::2], strict=False):
            less = one if self._replaces(parts[one], parts[other], 0.5) else other
            parts[less] = parts[less]._replace(whole=False)
        self._parts = []
        self._append_joined(parts)
        self._group = self._group_after(open_group)
        self._every *= 2

    def _group_after(self, open_group: int) -> int:
        """Stretches of the last group, when two groups become one."""
        last = self._group or self._every
        return last if open_group else (self._every + last) % (2 * self._every)


class _Stretch(NamedTuple):
    """Neighbouring samples, (n, c): a whole stretch at the full rate, or the play extremes of several."""

    table: Array
    whole: bool

    @property
    def way(self) -> float:
        """Way from the lowest to the highest position of the motor."""
        return float(np.ptp(self.table[:, 1]))


def play_extremes(table: Array) -> Array:
    """Rows of which a play with any gap keeps a memory: the extremes of the motor, and those behind them in turn.

    Later and larger motions wipe out what was before: of rows (n, c) with the motor in the second column the earlier
    of highest and lowest stays, the later one, the extreme of the other side behind that, and so on to the end.
    """
    motor = table[:, 1]
    # Of equal extremes the last wipes out the others: a machine at rest, whose encoder chatters, leaves two samples.
    high, low = _last(motor, np.max), _last(motor, np.min)
    places, upper = [min(high, low)], high < low
    while places[-1] < motor.size - 1:
        begin = places[-1] + 1
        places.append(begin + _last(motor[begin:], np.min if upper else np.max))
        upper = not upper
    return table[places]


def _last(values: Array, extreme: Callable[[Array], float]) -> int:
    """Place of the last of the extreme values."""
    return int(np.flatnonzero(values == extreme(values))[-1])
