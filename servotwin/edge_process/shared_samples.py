"""Samples in memory that the control process writes and the link process reads, so that the tick sends nothing.

The ring buffer of the agent lies in this memory, where the edge's file allows the live view. The reader takes no lock:
it looks at the number of samples before and after it copies, and drops what may have been overwritten meanwhile.
"""

from __future__ import annotations

import mmap
import os
from array import array
from collections.abc import Callable, Sequence
from struct import Struct
from typing import NamedTuple

from servotwin.edge.recorder import Recorder
from servotwin.errors import InvalidInput

MakeRecorder = Callable[[Sequence[str], int], Recorder]
"""(names, capacity) -> ring buffer of a boot."""
_HEAD = Struct("4Q")
"""Numbers of boots and of samples so far, samples that fit per channel, and channels."""
_BOOT, _SAMPLES, _CAPACITY, _CHANNELS = range(4)


class SharedRecorder(Recorder):
    """Ring buffer in shared memory; `samples` is written there last, after what it counts.

    Parameters
    ----------
    names : sequence of str
    capacity : int
    memory : memoryview
        Of `size(names, capacity)` bytes at least; a boot before has left its numbers in it.
    """

    def __init__(self, names: Sequence[str], capacity: int, memory: memoryview) -> None:
        super().__init__(names, 1)
        self.capacity = capacity
        self._head = memory[: _HEAD.size].cast("Q")
        self._head[_SAMPLES], self._head[_CAPACITY], self._head[_CHANNELS] = 0, capacity, len(names)
        self._head[_BOOT] += 1
        self._shared = _channels(memory, capacity, len(names))

    @staticmethod
    def size(names: Sequence[str], capacity: int) -> int:
        """Bytes of memory that it takes."""
        return _HEAD.size + 8 * capacity * len(names)

    def append(self, *values: float) -> None:
        """Record one sample of every channel, in the order of `names`."""
        place = self.samples % self.capacity
        for ring, value in zip(self._shared, values, strict=True):
            ring[place] = value
        self.samples += 1
        self._head[_SAMPLES] = self.samples

    def extend(self, *blocks: array[float]) -> None:
        """Record equally long blocks, one per channel in the order of `names`."""
        count = len(blocks[0])
        for ring, block in zip(self._shared, blocks, strict=True):
            _write(ring, block[max(0, count - self.capacity) :], self.samples + count)
        self.samples += count
        self._head[_SAMPLES] = self.samples

    def cut(self, first: int, last: int) -> dict[str, array[float]]:
        """Copy samples first ... last - 1 of every channel; raises InvalidInput as the recorder does."""
        self._check(first, last)
        return {name: _read(ring, first, last) for name, ring in zip(self.names, self._shared, strict=True)}


class SampleMemory:
    """Shared memory of one edge, for the recorders of its boots.

    Parameters
    ----------
    least : int
        Samples that it holds per channel at least, so that the reader may come late.

    Attributes
    ----------
    descriptor : int
        To be passed on to the link process.

    Raises
    ------
    InvalidInput
        This system has no such memory.
    """

    def __init__(self, least: int) -> None:
        self._least = least
        try:
            self.descriptor = os.memfd_create("servotwin-samples")
        except (AttributeError, OSError) as error:
            raise InvalidInput(f"[twin]: live = true: this system has no memory to share ({error})") from None
        self._memory: memoryview | None = None

    def recorder(self, names: Sequence[str], capacity: int) -> Recorder:
        """Make the ring buffer of a boot."""
        held = max(capacity, self._least)
        if self._memory is None:
            size = SharedRecorder.size(names, held)
            os.ftruncate(self.descriptor, size)
            self._memory = memoryview(mmap.mmap(self.descriptor, size))
            self._memory[:] = bytes(size)  # every page is touched now, and none by a tick
        return SharedRecorder(names, held, self._memory)

    def close(self) -> None:
        """Close the descriptor; what is mapped stays until its users are gone."""
        os.close(self.descriptor)


class ReadSamples(NamedTuple):
    """Samples of a boot: number of the boot, index of the first one, and the channels, equally long."""

    boot: int
    first: int
    channels: list[array[float]]


class SampleReader:
    """Reads the shared memory; a position in it is a boot's number and a sample's index.

    Parameters
    ----------
    descriptor : int
        Closed by `close`.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory: memoryview | None = None

    @property
    def position(self) -> tuple[int, int]:
        """Number of the boot that records, and of its samples so far; (0, 0): none does yet."""
        head = self._head()
        return (0, 0) if head is None else (head[_BOOT], head[_SAMPLES])

    def read(self, first: int, last: int) -> ReadSamples | None:
        """Copy samples first ... last - 1 of the boot that records; None: some are overwritten, or not there yet."""
        head = self._head()
        if head is None or self._memory is None:
            return None
        boot, capacity = head[_BOOT], head[_CAPACITY]
        if not head[_SAMPLES] - capacity <= first < last <= head[_SAMPLES]:
            return None
        rings = _channels(self._memory, capacity, head[_CHANNELS])
        found = ReadSamples(boot, first, [_read(ring, first, last) for ring in rings])
        # The one that is being written is not counted yet.
        intact = head[_BOOT] == boot and head[_SAMPLES] + 1 - capacity <= first
        return found if intact else None

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self._descriptor)

    def _head(self) -> memoryview | None:
        if self._memory is None:
            size = os.fstat(self._descriptor).st_size
            if size < _HEAD.size:
                return None
            self._memory = memoryview(mmap.mmap(self._descriptor, size, prot=mmap.PROT_READ))
        return self._memory[: _HEAD.size].cast("Q")


def _channels(memory: memoryview, capacity: int, count: int) -> list[memoryview[float]]:
    """Rings of the channels."""
    size = 8 * capacity
    starts = range(_HEAD.size, _HEAD.size + size * count, size)
    return [memory[start : start + size].cast("d") for start in starts]


def _write(ring: memoryview[float], block: array[float], end: int) -> None:
    """Write a block, the last sample of which has index `end` - 1."""
    capacity = len(ring)
    place = (end - len(block)) % capacity
    room = capacity - place
    ring[place : place + min(room, len(block))] = block[:room]
    ring[: max(0, len(block) - room)] = block[room:]


def _read(ring: memoryview[float], first: int, last: int) -> array[float]:
    place, count = first % len(ring), last - first
    read = array("d")
    read.frombytes(ring[place : place + count].tobytes())
    read.frombytes(ring[: count - len(read)].tobytes())
    return read
