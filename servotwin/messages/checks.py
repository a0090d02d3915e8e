"""What every message is checked against."""

from collections.abc import Iterable
from math import isfinite
from typing import Annotated

from msgspec import Meta

NAME_PATTERN = r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"
Name = Annotated[str, Meta(pattern=NAME_PATTERN)]
Text = Annotated[str, Meta(max_length=256)]
Count = Annotated[int, Meta(ge=0, le=2**53)]


class InvalidMessage(ValueError):
    """A message that must not be used, and what is wrong with it."""


def finite(value: float) -> float | None:
    """`value`, or None (unknown, unbounded) when it is not finite: how estimates are written into an update."""
    return value if isfinite(value) else None


def all_finite(values: Iterable[float]) -> bool:
    """Whether none is infinite or NaN."""
    return all(map(isfinite, values))


def require(condition: bool, otherwise: str) -> None:
    """InvalidMessage with that text unless the condition holds."""
    if not condition:
        raise InvalidMessage(otherwise)
