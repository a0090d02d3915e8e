"""Extent of random tests: few examples, always the same, in the suite; many fresh ones in `make fuzz`."""

from typing import Any

from hypothesis import settings

FUZZ = 20
"""So many times as many."""


def examples(number: int, **others: Any) -> settings:
    """Settings of a test that draws so many examples in the suite."""
    return settings(max_examples=extent(number, number * FUZZ), **others)


def extent(suite: int, fuzz: int) -> int:
    """Return the first number in the suite, the second one in `make fuzz`; for tests marked `exploration`."""
    return fuzz if settings.get_current_profile_name() == "fuzz" else suite
