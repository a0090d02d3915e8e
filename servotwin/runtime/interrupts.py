"""Interrupts (Ctrl-C) while worker processes run: only the process that started them handles one."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupts_blocked(*start: Callable[[], object]) -> Iterator[None]:
    """Block interrupts; a process started meanwhile never gets one, not even before `ignore_interrupts` runs.

    Parameters
    ----------
    *start : callable
        Called before interrupts are blocked: starts helper processes whose own start would let interrupts through
        again. That of multiprocessing is started anyway.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    for each in (resource_tracker.ensure_running, *start):
        each()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_interrupts() -> None:
    """Leave an interrupt to the process that started this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
