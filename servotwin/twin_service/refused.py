"""A message that the service does not take, and how HTTP says so."""

from __future__ import annotations

from collections.abc import Mapping

from servotwin.messages import Refusal

STATUS: Mapping[Refusal, int] = {
    Refusal.NOT_UNDERSTOOD: 400,
    Refusal.UNKNOWN_SCHEMA: 400,
    Refusal.BAD_CHECKSUM: 400,
    Refusal.OTHER_NAME: 400,
    Refusal.BAD_TOKEN: 401,
    Refusal.UNKNOWN_SERVO: 404,
    Refusal.CONFLICT: 409,
    Refusal.TOO_LARGE: 413,
    Refusal.FUTURE: 422,
    Refusal.TOO_MANY: 429,
    Refusal.UNAVAILABLE: 503,
}


class Refused(Exception):
    """Why something was not taken.

    Parameters
    ----------
    refusal : Refusal
    detail : str
        One sentence, for whoever sent it: no secret, nothing of the service's inside.
    status : int, optional
        Of HTTP; as `STATUS` says by default.
    close : bool
        Whether the connection is of no more use.
    """

    def __init__(self, refusal: Refusal, detail: str, status: int | None = None, close: bool = False) -> None:
        super().__init__(detail)
        self.refusal, self.detail, self.close = refusal, detail, close
        self.status = STATUS[refusal] if status is None else status
