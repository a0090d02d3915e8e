"""Extent of random tests: few examples, always the same, in the suite; many fresh ones in `make fuzz`."""

from collections.abc import Iterable
from typing import Any, TypeVar

import pytest
from hypothesis import settings

T = TypeVar("T")
FUZZ = 20
"""So many times as many."""


def examples(number: int, **others: Any) -> settings:
    """Settings of a test that draws so many examples in the suite."""
    return settings(max_examples=extent(number, number * FUZZ), **others)


def extent(suite: T, fuzz: T) -> T:
    """Return the first value in the suite, the second one in `make fuzz`; for tests marked `random`."""
    return fuzz if settings.get_current_profile_name() == "fuzz" else suite


def sized(kinds: Iterable[str], kept: dict[str, int], many: int) -> list[Any]:
    """Return cases of (kind, how many): the kept ones, and as explorations many of every kind."""
    return [*kept.items(), *(_exploration((kind, many)) for kind in kinds)]


def explored(cases: Iterable[Any], *kept: int) -> list[Any]:
    """Return the cases of a parametrised test, of which all but the kept ones (by place) are explorations."""
    return [case if at in kept else _exploration(case) for at, case in enumerate(cases)]


def _exploration(case: Any) -> Any:
    values = case if type(case) is tuple else (case,)  # a named tuple is one value
    return pytest.param(*values, marks=pytest.mark.exploration)
