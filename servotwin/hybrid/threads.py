"""Work shared among threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Result = TypeVar("_Result")


def on_threads(work: Callable[[], _Result], workers: int) -> list[_Result]:
    """Do the same work so many times at once, and return all results.

    The calling thread takes part: ensembles are mostly so short that the start of a thread counts.

    Parameters
    ----------
    work : callable
    workers : int
        1 or more.
    """
    if workers == 1:
        return [work()]
    with ThreadPoolExecutor(workers - 1) as pool:
        others = [pool.submit(work) for _ in range(workers - 1)]
        own = work()
        return [own, *(other.result() for other in others)]
