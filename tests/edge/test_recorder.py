"""The ring buffer: whatever was recorded last can be cut, however it was recorded."""

from array import array

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.edge.recorder import Recorder, as_floats
from servotwin.errors import InvalidInput


@given(st.integers(1, 9), st.lists(st.integers(0, 25), max_size=8), st.data())
def test_any_samples_in_the_buffer_can_be_cut(capacity: int, blocks: list[int], data: st.DataObject) -> None:
    recorder, total = Recorder(("a", "b"), capacity), 0
    for count in blocks:
        values = array("d", range(total, total + count))
        if count == 1:
            recorder.append(values[0], -values[0])
        else:
            recorder.extend(values, array("d", [-value for value in values]))
        total += count
    assert (recorder.samples, recorder.oldest) == (total, max(0, total - capacity))
    if total == 0:
        return
    first = data.draw(st.integers(recorder.oldest, total - 1))
    last = data.draw(st.integers(first + 1, total))
    cut = recorder.cut(first, last)
    assert list(cut["a"]) == [float(k) for k in range(first, last)]
    assert list(cut["b"]) == [-float(k) for k in range(first, last)]


@pytest.mark.parametrize(("first", "last"), [(2, 8), (6, 11), (6, 6), (-1, 2)])
def test_samples_outside_the_buffer_are_refused(first: int, last: int) -> None:
    recorder = Recorder(("a",), 5)
    recorder.extend(array("d", range(10)))
    with pytest.raises(InvalidInput, match="5 to 10 are in the recorder"):
        recorder.cut(first, last)


def test_a_cut_is_a_copy() -> None:
    recorder = Recorder(("a",), 4)
    recorder.extend(array("d", range(4)))
    cut = recorder.cut(0, 4)["a"]
    recorder.append(9.0)
    assert list(cut) == [0.0, 1.0, 2.0, 3.0]


def test_channels_stay_together() -> None:
    recorder = Recorder(("a", "b"), 4)
    with pytest.raises(ValueError, match="zip"):
        recorder.append(1.0)
    with pytest.raises(InvalidInput, match="capacity"):
        Recorder(("a",), 0)


@pytest.mark.parametrize(
    "block",
    [
        [1.0, 2.0, 3.0],
        (1, 2, 3),
        array("d", [1.0, 2.0, 3.0]),
        array("f", [1.0, 2.0, 3.0]),
        np.array([1.0, 2.0, 3.0]),
        np.array([1.0, 9.0, 2.0, 9.0, 3.0, 9.0])[::2],
        np.array([1, 2, 3]),
        range(1, 4),
    ],
    ids=repr,
)
def test_blocks_of_any_kind_become_doubles(block: object) -> None:
    floats = as_floats(block)  # type: ignore[arg-type]
    assert floats == array("d", [1.0, 2.0, 3.0])
