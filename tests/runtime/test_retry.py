"""Pauses between tries grow, end somewhere, and begin again after a success."""

import pytest

from servotwin.errors import InvalidInput
from servotwin.runtime.retry import Backoff, Retry


def test_pauses_grow_and_begin_again() -> None:
    backoff = Backoff(Retry(1.0, 2.0, 5.0))
    assert [backoff.failed(1.0) for _ in range(5)] == [1.0, 2.0, 4.0, 5.0, 5.0]
    assert backoff.failed(0.0) == 2.5
    backoff.succeeded()
    assert backoff.failed(1.0) == 1.0
    with pytest.raises(InvalidInput):
        Retry(2.0, 1.0, 1.0)


@pytest.mark.parametrize("values", [(0.0, 2.0, 60.0), (5.0, 0.5, 60.0), (5.0, 2.0, 1.0), (float("nan"), 2.0, 60.0)])
def test_bad_retries_are_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidInput, match="retry"):
        Retry(*values)
