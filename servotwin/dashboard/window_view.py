"""Channels of one window for a screen: the least and greatest sample of each column, or every sample."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

from servotwin.config.units import COMMAND_COLUMNS
from servotwin.dashboard.machine_facts import UNKNOWN, MachineFacts
from servotwin.errors import InvalidInput
from servotwin.messages import FINE, WindowMessage, unpack_channel
from servotwin.messages.windows import Channel

MAX_POINTS = 20_000
"""Samples of one channel in one answer: more are decimated, or asked for part by part."""


class SampleRange(NamedTuple):
    """Samples from `first` on, before `last`."""

    first: int
    last: int


def sample_range(window: WindowMessage, begin: float | None, end: float | None) -> SampleRange:
    """Samples of a part of a window, with those just outside; `begin`, `end`: s after its first sample; None: all.

    Raises
    ------
    InvalidInput
        The part is empty.
    """
    first = 0 if begin is None else max(0, int(min(begin * window.rate, window.samples)))
    last = window.samples if end is None else min(window.samples, int(min(end * window.rate, window.samples)) + 2)
    if last - first < 2:
        raise InvalidInput(f"from, to: must hold 2 samples at least of the {window.samples / window.rate:g} s")
    return SampleRange(first, last)


def envelope_indices(values: Sequence[float], columns: int) -> list[int]:
    """Indices of the least and the greatest sample of each column, in order, and of the first and last; all of few."""
    count = len(values)
    if count <= 4 * columns:
        return list(range(count))
    width, kept = -(-count // columns), {0, count - 1}
    for first in range(0, count, width):
        part = values[first : first + width]
        kept.add(first + part.index(min(part)))
        kept.add(first + part.index(max(part)))
    return sorted(kept)


def channel_series(
    window: WindowMessage, part: SampleRange, points: int, machine: MachineFacts = UNKNOWN
) -> list[dict[str, Any]]:
    """Channels of a window.

    Parameters
    ----------
    window : WindowMessage
    part : SampleRange
    points : int
        Columns of the screen: more than four samples a column are decimated to the least and greatest of each.
    machine : MachineFacts
        Its units: windows themselves say V and m of every machine.

    Returns
    -------
    list of dict
        name, unit (empty: unknown), time (s after the window's first sample), values (in that unit), and samples: how
        many there are in the part. Those that were rounded finely are put together.
    """
    shown = []
    for channel in window.channels:
        if channel.name.endswith(FINE):
            continue
        values = _samples(window, channel, part)
        kept = envelope_indices(values, points)
        shown.append(
            {
                "name": channel.name,
                "unit": _unit(channel, machine),
                "samples": len(values),
                "time": [round((part.first + k) / window.rate, 9) for k in kept],
                "values": [values[k] for k in kept],
            }
        )
    return shown


def whole_channel(window: WindowMessage, name: str) -> array[float] | None:
    """Every sample of a channel; None: the window has none of that name."""
    channel = window.channel(name)
    return None if channel is None else _samples(window, channel, SampleRange(0, window.samples))


def _samples(window: WindowMessage, channel: Channel, part: SampleRange) -> array[float]:
    values = unpack_channel(_cut(channel, part))
    fine = window.channel(channel.name + FINE)
    if fine is None:
        return values
    return array("d", map(float.__add__, values, unpack_channel(_cut(fine, part))))


def _cut(channel: Channel, part: SampleRange) -> Channel:
    return Channel(
        channel.name, channel.unit, channel.scale, channel.offset, channel.data[2 * part.first : 2 * part.last]
    )


def window_columns(window: WindowMessage, machine: MachineFacts = UNKNOWN) -> dict[str, list[Any]]:
    """Every sample of every channel, column by column, for a file; the columns' names are those of logs, with units.

    A unit that is not known yet, as before the machine's first estimate, is left out.
    """
    whole = SampleRange(0, window.samples)
    columns: dict[str, list[Any]] = {
        "time_s": [round(window.start + k / window.rate, 9) for k in range(window.samples)]
    }
    for channel in window.channels:
        if not channel.name.endswith(FINE):
            columns[_column(channel, machine)] = _samples(window, channel, whole).tolist()
    return columns


def _unit(channel: Channel, machine: MachineFacts) -> str:
    """Unit of a channel on this machine; empty: not known."""
    of_machine = {"position": machine.travel_unit, "reference": machine.travel_unit, "voltage": machine.command_unit}
    return of_machine.get(channel.name, channel.unit)


def _column(channel: Channel, machine: MachineFacts) -> str:
    """Name of a channel's column."""
    unit = _unit(channel, machine)
    if channel.name == "voltage":
        return COMMAND_COLUMNS.get(unit, "command")
    return f"{channel.name}_{unit}" if unit else channel.name
