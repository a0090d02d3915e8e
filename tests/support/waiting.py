"""Waiting for other threads and processes."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

PATIENCE = 90.0
"""s, after which a condition is not waited for any longer."""


def until(condition: Callable[[], T], seconds: float = PATIENCE) -> T:
    """Wait for a condition; returns its first true value."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return found
