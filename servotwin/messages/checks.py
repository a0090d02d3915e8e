"""What every message is checked against."""

from collections.abc import Iterable
from math import isfinite
from typing import Annotated

from msgspec import Meta

from servotwin.messages.refusals import Refusal

NAME_PATTERN = r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"
Name = Annotated[str, Meta(pattern=NAME_PATTERN)]
Text = Annotated[str, Meta(max_length=256)]
Count = Annotated[int, Meta(ge=0, le=2**53)]


class InvalidMessage(ValueError):
    """A message that must not be used, and what is wrong with it.

    Parameters
    ----------
    text : str
    refusal : Refusal
        The same as a code.
    """

    def __init__(self, text: str, refusal: Refusal = Refusal.NOT_UNDERSTOOD) -> None:
        super().__init__(text)
        self.refusal = refusal


def finite(value: float) -> float | None:
    """`value`, or None (unknown, unbounded) when it is not finite: how estimates are written into an update."""
    return value if isfinite(value) else None


def all_finite(values: Iterable[float]) -> bool:
    """Whether none is infinite or NaN."""
    return all(map(isfinite, values))


def require(condition: bool, otherwise: str, refusal: Refusal = Refusal.NOT_UNDERSTOOD) -> None:
    """InvalidMessage with that text and code unless the condition holds."""
    if not condition:
        raise InvalidMessage(otherwise, refusal)
