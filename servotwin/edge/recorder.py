"""Ring buffer of named signals, and the windows that are cut from it."""

from array import array
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from servotwin.errors import InvalidInput

Floats = Iterable[float]

TIMED = "timed"
"""Reason of a window that is cut because the filter's longest pause is over."""


class Cut(NamedTuple):
    """Window of recorded samples first .. last - 1 of one boot, before it is filtered or packed.

    Attributes
    ----------
    first : int
        Index of the first sample since the start of the edge.
    sequence : int
        Number of the window in this boot.
    reason : str
        Reason for which it was cut.
    parameter_version : int
        Version in force when it was cut.
    before : float
        Reference just before the first sample, m.
    signals : dict of str to array of double
        Channels, equally long: m, rad, m, V.
    gap : float or None
        Total gap for which the update in force was made, rad; None: no update is in force, or it names no gap.
    basis : int or None
        Sequence of the window of this boot from which this update was made.
    """

    first: int
    sequence: int
    reason: str
    parameter_version: int
    before: float
    signals: dict[str, "array[float]"]
    gap: float | None = None
    basis: int | None = None

    @property
    def samples(self) -> int:
        """Samples per channel."""
        return len(self.signals["reference"])

    @property
    def last(self) -> int:
        """Index of the first sample after it."""
        return self.first + self.samples


class Recorder:
    """Ring buffer of the last `capacity` samples of each channel, numbered since the start.

    Parameters
    ----------
    names : sequence of str
    capacity : int
        Samples per channel.
    """

    def __init__(self, names: Sequence[str], capacity: int) -> None:
        if capacity < 1:
            raise InvalidInput(f"recorder capacity = {capacity!r} samples: must be at least 1")
        self.names = tuple(names)
        self.capacity = capacity
        self.samples = 0
        self._rings = [array("d", bytes(8 * capacity)) for _ in self.names]

    @property
    def oldest(self) -> int:
        """Index of the oldest sample in the buffer."""
        return max(0, self.samples - self.capacity)

    def append(self, *values: float) -> None:
        """Record one sample of every channel, in the order of `names`."""
        place = self.samples % self.capacity
        for ring, value in zip(self._rings, values, strict=True):
            ring[place] = value
        self.samples += 1

    def extend(self, *blocks: "array[float]") -> None:
        """Record equally long blocks, one per channel in the order of `names`."""
        count = len(blocks[0])
        for ring, block in zip(self._rings, blocks, strict=True):
            self._write(ring, block[max(0, count - self.capacity) :], self.samples + count)
        self.samples += count

    def cut(self, first: int, last: int) -> dict[str, "array[float]"]:
        """Copy samples first ... last - 1 of every channel.

        Raises
        ------
        InvalidInput
            Some of them are not recorded yet, or overwritten.
        """
        self._check(first, last)
        return {name: self._read(ring, first, last) for name, ring in zip(self.names, self._rings, strict=True)}

    def constant(self, name: str, count: int) -> float | None:
        """Return the value of a channel in all of the last `count` samples; None: it changed, or there are too few."""
        if not 0 < count <= self.samples:
            return None
        values = set(self.cut(self.samples - count, self.samples)[name])
        return values.pop() if len(values) == 1 else None

    def _check(self, first: int, last: int) -> None:
        if not self.oldest <= first < last <= self.samples:
            raise InvalidInput(f"samples {first} to {last}: {self.oldest} to {self.samples} are in the recorder")

    def _write(self, ring: "array[float]", block: "array[float]", end: int) -> None:
        """Write a block of at most `capacity` samples, the last of which has index `end` - 1."""
        place = (end - len(block)) % self.capacity
        room = self.capacity - place
        ring[place : place + len(block)] = block[:room]
        # The part beyond the end of the ring continues at its begin.
        ring[: max(0, len(block) - room)] = block[room:]

    def _read(self, ring: "array[float]", first: int, last: int) -> "array[float]":
        place, count = first % self.capacity, last - first
        part = ring[place : place + count]
        return part + ring[: count - len(part)]


def as_floats(block: Floats) -> "array[float]":
    """Convert a block to an array of doubles; buffers of doubles (numpy's) are copied as a whole."""
    if isinstance(block, array) and block.typecode == "d":
        return block
    try:
        view = memoryview(block)  # type: ignore[arg-type]
    except TypeError:
        return array("d", block)
    # Element by element: the bytes of another layout are no doubles.
    if view.format != "d" or not view.contiguous:
        return array("d", block)
    floats = array("d")
    floats.frombytes(view.cast("B"))
    return floats
