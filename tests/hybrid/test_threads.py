"""Work shared among threads."""

import threading

import pytest

from servotwin.hybrid.ensemble import on_threads


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_worker_works_once_and_the_caller_is_one_of_them(workers: int) -> None:
    together = threading.Barrier(workers, timeout=20.0)

    def work() -> int:
        together.wait()
        return threading.get_ident()

    found = on_threads(work, workers)
    assert len(set(found)) == workers
    assert threading.get_ident() in found


@pytest.mark.parametrize("workers", [1, 3])
def test_an_error_of_a_worker_is_raised(workers: int) -> None:
    def work() -> None:
        raise ValueError("no such member")

    with pytest.raises(ValueError, match="no such member"):
        on_threads(work, workers)
