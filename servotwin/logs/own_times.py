"""Channels that each have times of their own, as columns of one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.logs.columns import LogColumns, Requested, among
from servotwin.plant.signals import Array

TIME = "time [s]"
"""Name of the column of times."""
_JUMP, _UNUSUAL = 0.5, 2.0  # of the range, and times the usual step


class TimedChannel(NamedTuple):
    """Times in s and values of one channel, (n,) each."""

    time: Array
    values: Any


def one_table(names: Sequence[str], requested: Requested, read: Callable[[str], TimedChannel]) -> LogColumns:
    """Bring the requested channels to the times of the one with most samples, by straight lines between samples.

    Where a channel jumps by more than half its range the nearer sample counts; one whose time goes back is left out.
    `read` gives a channel by its name; the column `TIME` holds the times.
    """
    requested = among(requested, (TIME, *names))
    channels = {name: read(name) for name in names if name in requested}
    if not channels:
        return LogColumns({}, (TIME, *names), {})
    time = max((channel.time for channel in channels.values()), key=len)
    values: Mapping[str, Any] = {name: _at(time, channel) for name, channel in channels.items()}
    return LogColumns({TIME: time, **values} if TIME in requested else values, (TIME, *names), {})


def with_unit(name: str, unit: str) -> str:
    """Name of a column: its unit in brackets where there is one."""
    return f"{name} [{unit}]" if unit else name


def _at(time: Array, channel: TimedChannel) -> Any:
    values = np.asarray(channel.values)
    if channel.time is time or np.array_equal(channel.time, time) or values.dtype.kind not in "fiub":
        return values
    onward = np.concatenate([[True], channel.time[1:] > np.maximum.accumulate(channel.time)[:-1]])
    own, numbers = channel.time[onward], values[onward].astype(float)
    if own.size == 0:
        return np.full(time.size, np.nan)
    # Beyond its own first and last sample nothing is known of a channel.
    between = np.interp(time, own, numbers, left=np.nan, right=np.nan)
    return np.where(_jumps(time, own, numbers), numbers[_nearest(time, own)], between)


def _nearest(time: Array, own: Array) -> Any:
    """(n,) place of the own time next to each of `time`."""
    return np.searchsorted(0.5 * (own[:-1] + own[1:]), time)


def _jumps(time: Array, own: Array, numbers: Array) -> Any:
    """(n,) true between two samples half the channel's range apart: a wrapped angle or a command passes no middle."""
    finite = numbers[np.isfinite(numbers)]
    steps = np.abs(np.diff(numbers))
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    far = steps > max(_JUMP * float(np.ptp(finite)) if finite.size else 0.0, _UNUSUAL * usual)
    place = np.searchsorted(own, time, side="right") - 1
    inside = (place >= 0) & (place < far.size)
    return inside & (far[np.clip(place, 0, far.size - 1)] if far.size else False)
