"""What is read of ring buffers that are written at the same time: nothing that was written over, cut at versions."""

from array import array

from hypothesis import given
from hypothesis import strategies as some

from servotwin.drives.opcua.ring import RingReading, VersionChange, blocks, is_valid, oldest, whole

SIZE, MARGIN = 12, 3


def rings(written: int) -> tuple[list[float], ...]:
    """Rings after so many samples, sample k of signal s being 1000 s + k."""
    values = [[0.0] * SIZE for _ in range(4)]
    for k in range(written):
        for s, ring in enumerate(values):
            ring[k % SIZE] = 1000.0 * s + k
    return tuple(values)


@given(some.integers(0, 60), some.integers(0, 5), some.integers(0, MARGIN), some.integers(0, 70))
def test_only_samples_not_overwritten_are_read(before: int, more: int, unannounced: int, first: int) -> None:
    """The arrays are read when up to `more` samples were counted since and up to a margin are being written."""
    after = before + more
    reading = RingReading(before, after, rings(after + unannounced))
    begin, signals = whole(reading, first, MARGIN)
    numbers = list(range(begin, before))
    for s, signal in enumerate(signals):
        assert list(signal) == [1000.0 * s + k for k in numbers]
    assert begin == min(max(first, oldest(reading, MARGIN)), before)
    assert not numbers or begin >= after + unannounced - SIZE


@given(
    some.integers(0, 50), some.integers(1, 30), some.lists(some.integers(0, 90), min_size=1, max_size=5, unique=True)
)
def test_blocks_are_cut_where_versions_change(first: int, count: int, since: list[int]) -> None:
    changes = [VersionChange(at, version) for version, at in enumerate(sorted(since))]
    signals = [array("d", [1000.0 * s + first + k for k in range(count)]) for s in range(4)]
    found = blocks(first, signals, changes)
    assert [sample for block in found for sample in range(block.first, block.last)] == [*range(first, first + count)]
    for block in found:
        for number, value in zip(range(block.first, block.last), block.voltage, strict=True):
            assert value == 3000.0 + number
            assert block.version == max((c.version for c in changes if c.since <= number), default=0)


def test_values_that_are_no_reading_are_detected() -> None:
    good = [[0.0, 1.0]] * 4
    assert is_valid(RingReading(1, 2, tuple(good)))
    for rings_ in ([None] * 4, [[1]] * 4, [[]] * 4, [*good[:3], [0.0]], [["a", "b"]] * 4):
        assert not is_valid(RingReading(1, 2, tuple(rings_)))
    assert not is_valid(RingReading(None, 2, tuple(good)))
