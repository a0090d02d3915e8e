"""Cleaning of recorded samples: what is wrong is mended, left out or counted; nothing is refused for one sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.logs.outliers import frozen, outliers
from servotwin.logs.stamps import in_order, spread
from servotwin.logs.wrapping import check_followed, pauses, unwrapped, unwrapped_turns, with_turns_in_pauses
from servotwin.plant.signals import Array

_Mask = np.ndarray[Any, np.dtype[np.bool_]]

_LARGEST = 1e100  # squares of larger values overflow
_STALE = 50.0  # times the usual interval: a first sample so far before the others is an old one
_HELD_CHANGES, _HELD = 50, 0.9  # changes of a channel that is held, and share of them after equally many samples
MEASURED = ("motor", "load")
"""Channels that encoders measure; commands and references are held on purpose."""
_STEPS = (0.1, 0.9)  # quantiles of its steps, which differ
_SLOWER = 0.95  # share of a slower channel's samples that follow the one before after equally many rows


SHARED = "samples with the time stamp of the one before, spread between stamps"
OUT_OF_ORDER, SAME_TIME = "samples out of order in time", "samples at the time of the one before"
REPEATED = "samples that repeat the one before in every column"
BETWEEN = "rows between the samples of a slower channel"
"""Names of defects."""


class Cleaned(NamedTuple):
    """Samples in increasing time, all finite, and what was done to them.

    Attributes
    ----------
    time : (n,) array
        s.
    channels : mapping
        (n,) arrays by name.
    found : mapping
        Number of samples by defect, in words; only defects that occur.
    parted : list of float
        Times, s, of the samples behind pauses in which angles that wrap turned by nobody knows how much.
    alone : (n,) bool array or None
        Of a thinned log: samples between the stretches that were kept at the full rate.
    """

    time: Array
    channels: Mapping[str, Array]
    found: Mapping[str, int]
    parted: Sequence[float] = ()
    alone: _Mask | None = None


def cleaned(time: Array, channels: Mapping[str, Array], turns: Mapping[str, float], first: bool = True) -> Cleaned:
    """Leave out samples that are damaged, repeated, stale or out of order; unwrap angles; count all of it.

    Parameters
    ----------
    time : (n,) array
        s; NaN where the log has none.
    channels : mapping
        (n,) arrays by name.
    turns : mapping
        Full turn of the channels that are angles, in their units.
    first : bool
        The log begins here: a first sample long before the others is an old one.
    """
    found: dict[str, int] = {}
    names = list(channels)
    table = np.column_stack([time, *channels.values()])

    def keep(kept: _Mask, defect: str) -> None:
        nonlocal table
        if not kept.all():
            found[defect] = int(np.sum(~kept))
            table = table[kept]

    slowest, turned = _of_slowest(table[:, 1:]), dict[str, int]()
    if not slowest.all():
        for place, name in enumerate(names, 1):
            if name in turns and np.isfinite(table[:, place]).all():
                # Between two samples of the slower one an angle may make more than half a turn.
                table[:, place], turned[name] = unwrapped(table[:, place], turns[name])
        keep(slowest, BETWEEN)
    keep(np.all(np.abs(table) <= _LARGEST, axis=1), "samples without a number in some column")
    if first:
        keep(~_long_before(table[:, 0]), "stale samples, long before all others")
    keep(in_order(table[:, 0]), OUT_OF_ORDER)
    keep(~_alone_at_the_end(table[:, 0]), "samples with a time stamp far behind all others")
    table[:, 0], shared = spread(table)
    if shared:
        found[SHARED] = shared
    keep(np.diff(table[:, 0], prepend=-np.inf) > 0.0, SAME_TIME)
    parted: list[float] = []
    for place, name in enumerate(names, 1):
        if name in turns:
            table[:, place], count, lost = _turned_on(name, table[:, 0], table[:, place], turns[name])
            parted += lost
            if count := count + turned.get(name, 0):
                found[unwrapped_turns(name)] = count
    for place, name in enumerate(names, 1):
        # A command may have pulses, such as the kick of a derivative: what is left out need not be wrong.
        what = "spikes" if name in MEASURED else "short pulses"
        keep(~outliers(table[:, place]), f"samples in {what} of {name}")
    for place, name in enumerate(names, 1):
        if name in MEASURED:
            keep(~frozen(table[:, place]), f"samples of a {name} that stood still until it jumped")
    new = {name: _new(table[:, place]) for place, name in enumerate(names, 1) if name in MEASURED}
    for name, rows in new.items():
        if not rows.all():
            found[f"repeats of a {name} that is written more often than it is measured"] = int(np.sum(~rows))
    keep(_telling(table[:, 1:], list(new.values())), REPEATED)
    if gaps := pauses(table[:, 0]):
        found["pauses longer than five intervals"] = len(gaps)
    return Cleaned(table[:, 0], {name: table[:, place] for place, name in enumerate(names, 1)}, found, parted)


def _of_slowest(channels: Array) -> _Mask:
    """True for the rows in which the channels with samples in every k-th row only have one."""
    result = np.ones(len(channels), dtype=np.bool_)
    for values in channels.T:
        known = np.isfinite(values)
        apart = np.diff(np.flatnonzero(known))
        usual = int(np.median(apart)) if apart.size else 1
        if usual > 1 and np.mean(apart == usual) >= _SLOWER:
            result &= known
    return result if result.any() else np.ones_like(result)


def _turned_on(name: str, time: Array, angle: Array, turn: float) -> tuple[Array, int, list[float]]:
    """An angle beyond its full turn, the number of turns, and the times of pauses in which turns may be lost."""
    angle, count = unwrapped(angle, turn)
    if not count:
        return angle, 0, []
    check_followed(name, angle, turn)
    angle, lost = with_turns_in_pauses(time, angle, turn)
    return angle, count, lost


def _long_before(time: Array) -> _Mask:
    """True for a first sample long before the others."""
    result = np.zeros(time.size, dtype=np.bool_)
    if time.size > 2:
        intervals = np.diff(time)
        usual = float(np.median(np.abs(intervals)))
        result[0] = 0.0 < _STALE * usual < intervals[0]
    return result


def _alone_at_the_end(time: Array) -> _Mask:
    """True for a last sample long behind the others: behind a wrong stamp all others would be out of order."""
    intervals = np.diff(time)
    result = np.zeros(time.size, dtype=np.bool_)
    if intervals.size > 1:
        result[-1] = intervals[-1] > _STALE * np.median(intervals) > 0.0
    return result


def _telling(table: Array, new: Sequence[_Mask]) -> _Mask:
    """False for rows in which no channel is new, and none differs from the row before.

    Where one channel has news, repeats of another stay: what a hold delays is the fit's lag.
    """
    if all(rows.all() for rows in new):
        return np.ones(len(table), dtype=np.bool_)
    return np.any([*new, *(np.diff(table, axis=0, prepend=np.nan) != 0.0).T], axis=0)


def _new(values: Array) -> _Mask:
    """False for samples that repeat a value because the channel is written more often than it is measured.

    Its values last for the same number of samples at any speed, and change by different steps; those of an encoder
    with few counts last longer the slower it moves, and change by one count.
    """
    result = np.ones(values.size, dtype=np.bool_)
    changes = np.flatnonzero(np.diff(values)) + 1
    if changes.size < _HELD_CHANGES:
        return result
    lengths, steps = np.diff(changes), np.abs(np.diff(values))[changes - 1]
    usual = int(np.median(lengths))
    if usual < 2 or np.mean(lengths % usual == 0) < _HELD or np.ptp(np.quantile(steps, _STEPS)) <= 0.1 * steps.mean():
        return result
    # A channel at rest goes on being measured: of a longer run one in so many samples is new.
    since = (
        np.arange(values.size)
        - np.concatenate([[0], changes])[np.searchsorted(changes, np.arange(values.size), side="right")]
    )
    return np.asarray(since % usual == 0)
