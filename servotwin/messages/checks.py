"""Checks of messages, and the codes under which they are refused."""

from collections.abc import Iterable
from enum import StrEnum
from math import isfinite
from typing import Annotated

from msgspec import Meta

NAME_PATTERN = r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"
Name = Annotated[str, Meta(pattern=NAME_PATTERN)]
Text = Annotated[str, Meta(max_length=256)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
LARGEST_REPORTED = 2**52
"""Largest number that an edge may report and the twin counts on from: half a count, so that what follows is one too."""
Reported = Annotated[int, Meta(ge=0, le=LARGEST_REPORTED)]


class Refusal(StrEnum):
    """Reason code of a message that the twin refused, in answers, metrics and the edge's counts."""

    TOO_LARGE = "too_large"
    NOT_UNDERSTOOD = "not_understood"
    UNKNOWN_SCHEMA = "unknown_schema"
    BAD_CHECKSUM = "bad_checksum"
    OTHER_NAME = "other_name"
    CONFLICT = "conflict"
    UNKNOWN_SERVO = "unknown_servo"
    BAD_TOKEN = "bad_token"
    FUTURE = "future"
    TOO_MANY = "too_many"
    UNAVAILABLE = "unavailable"
    SUPERSEDED = "superseded"

    @property
    def temporary(self) -> bool:
        """True where the same message may be accepted later: the edge keeps it; any other it drops and counts."""
        return self in (
            Refusal.BAD_TOKEN,
            Refusal.FUTURE,
            Refusal.TOO_MANY,
            Refusal.UNAVAILABLE,
            Refusal.SUPERSEDED,
            Refusal.UNKNOWN_SCHEMA,
            Refusal.UNKNOWN_SERVO,
        )


class InvalidMessage(ValueError):
    """A message that must not be used, with the reason.

    Parameters
    ----------
    text : str
    refusal : Refusal
        The reason as a code.
    """

    def __init__(self, text: str, refusal: Refusal = Refusal.NOT_UNDERSTOOD) -> None:
        super().__init__(text)
        self.refusal = refusal


def finite(value: float) -> float | None:
    """`value`, or None (unknown, unbounded) when it is not finite, as messages carry it."""
    return value if isfinite(value) else None


def all_finite(values: Iterable[float]) -> bool:
    """True where none is infinite or NaN."""
    return all(map(isfinite, values))


def require(condition: bool, otherwise: str, refusal: Refusal = Refusal.NOT_UNDERSTOOD) -> None:
    """Raise InvalidMessage with that text and code unless the condition holds."""
    if not condition:
        raise InvalidMessage(otherwise, refusal)
