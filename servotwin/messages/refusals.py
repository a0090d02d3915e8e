"""Why the twin does not take a message: one enumeration, in answers, metrics and the edge's counts."""

from enum import StrEnum


class Refusal(StrEnum):
    """Reason code of a message that was not taken."""

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

    @property
    def passing(self) -> bool:
        """Whether the same message may be taken later: the edge keeps it; otherwise it drops and counts it."""
        return self in (
            Refusal.BAD_TOKEN,
            Refusal.FUTURE,
            Refusal.TOO_MANY,
            Refusal.UNAVAILABLE,
            Refusal.UNKNOWN_SERVO,
        )
