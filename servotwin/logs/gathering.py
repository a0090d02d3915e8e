"""Samples of a log that come in blocks: cleaned, joined and, where there are millions, thinned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from servotwin.logs.cleaning import MEASURED, OUT_OF_ORDER, Cleaned, cleaned
from servotwin.logs.thinning import Stretches
from servotwin.logs.wrapping import NEAR_TURN, WITHIN, guessed_turn, pauses, unwrapped_turns
from servotwin.plant.signals import Array

MOST = 1_500_000
"""Samples that are held; a longer log is thinned."""
_BULK = (0.01, 0.99)  # quantiles of an angle, between which no spike counts
THINNED = "samples left out of a long log, between stretches at its full rate"
PARTED = "samples outside the longest part (in a pause an angle that wraps may have lost turns)"


class Gathering:
    """Cleaned samples so far.

    Parameters
    ----------
    turns : mapping
        As `cleaned` takes them.
    most : int
        Samples to hold.
    """

    def __init__(self, turns: Mapping[str, float], most: int = MOST) -> None:
        self._turns = dict(turns)
        self._guessed: dict[str, float] = {}
        self._kept = Stretches(most)
        self._names: tuple[str, ...] = ()
        self._last: Array | None = None
        self._found: Counter[str] = Counter()
        self._parted: list[float] = []  # times, before which turns may have been lost
        # Decided once for the log: angles that wrap, and those that cannot, for they go beyond a turn.
        self._wrapped: set[str] = set()
        self._ranges: dict[str, tuple[float, float]] = {}
        self.samples = 0

    def add(self, time: Array, channels: Mapping[str, Array]) -> None:
        """Add the next block: (n,) times in s and (n,) arrays by name, of which the first is the motor."""
        if not self.samples:
            self._guess_turns(channels)
        self.samples += len(time)
        self._names = tuple(channels)
        turns = self._within_a_turn(channels)
        part = cleaned(time, channels, turns, first=self._last is None)
        self._wrapped |= {name for name in turns if unwrapped_turns(name) in part.found}
        self._found.update(part.found)
        table = self._after_last(np.column_stack([part.time, *part.channels.values()]))
        if not len(table):
            return
        self._parted += part.parted
        if self._wrapped and self._last is not None and pauses(np.append(self._last[0], table[:, 0]))[:1] == [1]:
            self._parted.append(float(table[0, 0]))
        self._last = table[-1].copy()
        self._kept.add(table)

    def cleaned(self) -> Cleaned:
        """All samples so far; of a log that falls apart the longest part."""
        table, alone = self._kept.thinned()
        table = table if table.size else np.empty((0, 1 + len(self._names)))
        found = dict(self._found) | ({THINNED: self._kept.dropped} if self._kept.dropped else {})
        for name, turn in self._guessed.items():
            found[f"{unwrapped_turns(name)} (its jumps show a turn of {turn:.8g})"] = found.pop(
                unwrapped_turns(name), 0
            )
        if self._parted:
            places = np.split(np.arange(len(table)), np.searchsorted(table[:, 0], self._parted))
            longest = max(places, key=len)
            found[PARTED] = len(table) - len(longest)
            table, alone = table[longest], alone[longest]
        channels = dict(zip(self._names, table[:, 1:].T, strict=True))
        return Cleaned(table[:, 0], channels, found, alone=alone if alone.any() else None)

    def _guess_turns(self, channels: Mapping[str, Array]) -> None:
        """Take the turns that positions show of themselves: those of counts, and of encoders of many turns."""
        for name in MEASURED:
            turn = guessed_turn(channels[name]) if name in channels else None
            if turn is not None and not abs(self._turns.get(name, 0.0) / turn - 1.0) < NEAR_TURN:
                self._turns[name] = self._guessed[name] = turn

    def _within_a_turn(self, channels: Mapping[str, Array]) -> dict[str, float]:
        """Full turns of the angles that have stayed within one so far."""
        for name in self._turns:
            values = channels[name][np.isfinite(channels[name])] if name in channels else np.empty(0)
            if values.size:
                low, high = np.quantile(values, _BULK)
                before = self._ranges.get(name, (low, high))
                self._ranges[name] = (min(before[0], low), max(before[1], high))
        spans = {name: high - low for name, (low, high) in self._ranges.items()}
        return {name: turn for name, turn in self._turns.items() if spans.get(name, 0.0) <= WITHIN * turn}

    def _after_last(self, table: Array) -> Array:
        """The block behind the one before: later samples only, and angles in the turn in which they go on."""
        if self._last is None or not len(table):
            return table
        later = table[:, 0] > self._last[0]
        if not later.all():
            self._found[OUT_OF_ORDER] += int(np.sum(~later))
            table = table[later]
        for place, name in enumerate(self._names, 1):
            if name in self._turns and len(table):
                turn, step = self._turns[name], self._last[place] - table[0, place]
                low, high = self._ranges.get(name, (0.0, 0.0))
                if abs(abs(step) - turn) < NEAR_TURN * turn and high - low <= WITHIN * turn:
                    self._wrapped.add(name)
                if name in self._wrapped:
                    table[:, place] += turn * np.round(step / turn)
        return table
