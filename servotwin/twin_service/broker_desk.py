"""What edges ask over a broker, answered: the same checks, in the same order, as over HTTP."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

from servotwin.link.exchange import (
    Answer,
    Asked,
    Carry,
    Heard,
    Listen,
    NotTaken,
    Taken,
    answer,
    asked,
    stranger,
)
from servotwin.link.seal import key_of
from servotwin.messages import InvalidMessage, Refusal
from servotwin.store.records import PutResult
from servotwin.twin_service.auth import Authority
from servotwin.twin_service.ingest import Ingest
from servotwin.twin_service.limits import Buckets
from servotwin.twin_service.metrics import Metrics
from servotwin.twin_service.outgoing import Outgoing, sealed
from servotwin.twin_service.refused import Refused

log = logging.getLogger(__name__)
AGAIN_S = 1.0
"""Asked of an edge when nothing is taken just now."""


class Parts(NamedTuple):
    """What a desk works with; as the parts of the HTTP API.

    Attributes
    ----------
    authority : Authority
    knows : callable
        Whether a servo of that name is looked after here.
    buckets : Buckets
    ingest : Ingest
    outgoing : Outgoing
    came : callable
        Told when there is something new to work on.
    metrics : Metrics
    """

    authority: Authority
    knows: Callable[[str], bool]
    buckets: Buckets
    ingest: Ingest
    outgoing: Outgoing
    came: Callable[[], None]
    metrics: Metrics


class Desk:
    """Reads questions and finds the answers."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    def read(self, servo: str, data: bytes) -> Asked | bytes | None:
        """The question that a servo's edge asks; else the bytes to answer at once, or None where none can be given."""
        verifier = self._parts.authority.verifier(servo)
        try:
            if verifier is None:
                raise InvalidMessage(f"servo {servo!r} has no token", Refusal.BAD_TOKEN)
            return asked(key_of(verifier), servo, data)
        except InvalidMessage as error:
            too_large = error.refusal is Refusal.TOO_LARGE
            self._count(servo, Refusal.TOO_LARGE if too_large else Refusal.BAD_TOKEN, str(error))
            return None if too_large else stranger(data)

    async def answer(self, asked: Asked) -> bytes | None:
        """The bytes of the answer; None where the servo's token was taken away meanwhile."""
        try:
            said = await self._said(asked)
        except Refused as refused:
            self._count(asked.servo, refused.refusal, refused.detail)
            busy = refused.refusal in (Refusal.TOO_MANY, Refusal.UNAVAILABLE)
            said = NotTaken(refused.refusal, refused.detail, AGAIN_S if busy else 0.0)
        verifier = self._parts.authority.verifier(asked.servo)
        return None if verifier is None else answer(key_of(verifier), asked.servo, asked.serial, said)

    async def _said(self, asked: Asked) -> Answer:
        if not self._parts.knows(asked.servo):
            raise Refused(Refusal.UNKNOWN_SERVO, f"servo {asked.servo!r} is not looked after here")
        if isinstance(asked.question, Listen):
            return await self._heard(asked.servo, asked.question)
        return await self._taken(asked.servo, asked.question)

    async def _taken(self, servo: str, question: Carry) -> Taken:
        """Commit, then say so."""
        self._parts.buckets.take(servo)
        incoming, _ = self._parts.ingest.read(servo, question.body, question.encoding)
        if await self._parts.ingest.commit(incoming) is PutResult.NEW:
            self._parts.came()
        return Taken()

    async def _heard(self, servo: str, question: Listen) -> Heard:
        posted = await self._parts.outgoing.after(servo, question.after, question.wait)
        verifier = self._parts.authority.verifier(servo)
        if verifier is None:
            raise Refused(Refusal.BAD_TOKEN, "the token of this servo was taken away")
        return Heard(sealed(verifier, servo, posted))

    def _count(self, servo: str, code: Refusal, why: str) -> None:
        self._parts.metrics.refused.add(code.value)
        log.info("refused", extra={"servo": servo, "code": code.value, "why": why})
