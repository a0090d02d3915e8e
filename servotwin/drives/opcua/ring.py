"""Ring buffers that are read while they are written: selection of the samples not overwritten. Pure functions."""

from array import array
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from servotwin.edge.drive import Block


class RingReading(NamedTuple):
    """One reading of the rings.

    Attributes
    ----------
    before, after : int
        Sample counts just before and just after the rings were read.
    rings : tuple of sequence of float
        Equally long; sample k is at index k modulo their length.
    """

    before: int
    after: int
    rings: tuple[Sequence[float], ...]


class VersionChange(NamedTuple):
    """A version of the parameters and the first sample under it."""

    since: int
    version: int


def is_valid(reading: Any) -> bool:
    """True where the values form a reading: a server may hold values of any type."""
    counts, rings = (reading.before, reading.after), reading.rings
    lists = all(isinstance(ring, list) and ring and all(type(value) is float for value in ring) for ring in rings)
    return lists and len({len(ring) for ring in rings}) == 1 and all(type(count) is int for count in counts)


def oldest(reading: RingReading, margin: int) -> int:
    """Number of the oldest sample not overwritten, where up to `margin` more than counted were being written."""
    return max(0, reading.after + margin - len(reading.rings[0]))


def whole(reading: RingReading, first: int, margin: int) -> tuple[int, list["array[float]"]]:
    """Return the samples from `first` on, or from the oldest one left: the number of the first, and the signals."""
    begin = min(max(first, oldest(reading, margin)), reading.before)
    return begin, [_unrolled(ring, begin, reading.before) for ring in reading.rings]


def blocks(first: int, signals: Sequence["array[float]"], changes: Sequence[VersionChange]) -> list[Block]:
    """Split the samples into blocks where the version changes; samples before the first change get its version."""
    last = first + len(signals[0])
    inside = [change for change in changes if first < change.since < last]
    start = next((change.version for change in reversed(changes) if change.since <= first), changes[0].version)
    split = []
    bounds = [VersionChange(first, start), *inside, VersionChange(last, 0)]
    for change, following in pairwise(bounds):
        part = slice(change.since - first, following.since - first)
        split.append(Block(change.since, change.version, *(signal[part] for signal in signals)))
    return [block for block in split if len(block.reference)]


def _unrolled(ring: Sequence[float], first: int, last: int) -> "array[float]":
    size = len(ring)
    begin, end = first % size, first % size + last - first
    return array("d", [*ring[begin:end], *ring[: max(0, end - size)]])
