"""Channels that each have times of their own, as columns of one table."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.logs.columns import LogColumns
from servotwin.plant.signals import Array

TIME = "time [s]"
"""Name of the column of times."""


class TimedChannel(NamedTuple):
    """Times in s and values of one channel, (n,) each."""

    time: Array
    values: Any


def one_table(names: Sequence[str], requested: Collection[str], read: Callable[[str], TimedChannel]) -> LogColumns:
    """Bring the requested channels to the times of the one with most samples, by straight lines between samples.

    `read` gives a channel by its name; the column `TIME` holds the times.
    """
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
    # Beyond its own first and last sample nothing is known of a channel.
    return np.interp(time, channel.time, values.astype(float), left=np.nan, right=np.nan)
