"""Lock-step: time is what a request says it is, and the answer comes when all that follows is committed."""

from __future__ import annotations

import asyncio
from collections import defaultdict

from fastapi import Request, Response

from servotwin.messages import Refusal, Window
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import Lease, MessageKind, PutResult
from servotwin.twin_service.dispatcher import LEASE_S, Dispatcher, Parts
from servotwin.twin_service.edge_api import Gate, encoding_of, packed, seconds
from servotwin.twin_service.ingest import Ingest, acknowledgement, end_of
from servotwin.twin_service.limits import Bodies
from servotwin.twin_service.pool import Worker, WorkerLost
from servotwin.twin_service.refused import Refused

ROUNDS = 64
"""Outcomes that one request may lead to."""
_AGAIN = "it could not be worked on now; the message is kept"


class StepApi:
    """A message or a wake-up goes the way of all others: put, claimed, worked on, committed; but awaited.

    Parameters
    ----------
    gate, bodies, ingest : Gate, Bodies, Ingest
    parts : Parts
    dispatcher : Dispatcher
        Not running: nothing happens but on request.
    owner : str
        Borrows under this name.
    """

    def __init__(
        self, gate: Gate, bodies: Bodies, ingest: Ingest, parts: Parts, dispatcher: Dispatcher, owner: str
    ) -> None:
        self._gate, self._bodies, self._ingest = gate, bodies, ingest
        self._parts, self._dispatcher, self._owner = parts, dispatcher, owner
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)

    async def receive(self, request: Request) -> Response:
        """A message arrives `now`: the twin's messages, an acknowledgement first, and when it wants to be woken."""
        servo, now = self._gate.admit(request, costs=False), seconds(request, "now")
        body = await self._bodies.read(request.headers.get("content-length"), request.receive)
        incoming, message = self._ingest.read(servo, body, encoding_of(request))
        if isinstance(message, Window) and end_of(message) > now + 1.0 / message.rate:
            raise Refused(Refusal.FUTURE, f"the window ends at {end_of(message):g} s, and it is {now:g} s")
        async with self._turns[servo]:
            put = await self._ingest.commit(incoming._replace(received=now))
            sent = await self._through(servo, now) if put is PutResult.NEW else []
        first = [acknowledgement(message)] if isinstance(message, Window) else []
        return await self._answer(servo, first + sent)

    async def wake(self, request: Request) -> Response:
        """It is `now`: what the twin sends without having been asked, and when it wants to be woken next."""
        servo, now = self._gate.admit(request, costs=False), seconds(request, "now")
        async with self._turns[servo]:
            sent = await self._through(servo, now)
        return await self._answer(servo, sent)

    async def next(self, request: Request) -> Response:
        """When the twin wants to be woken, s; null: never."""
        return packed(await self._wake(self._gate.admit(request, costs=False)))

    async def _answer(self, servo: str, sent: list[bytes]) -> Response:
        return packed({"messages": sent, "wake": await self._wake(servo)})

    async def _wake(self, servo: str) -> float | None:
        found = await self._parts.shelf.ask(lambda: self._parts.store.servo(servo))
        return None if found is None else found.wake

    async def _through(self, servo: str, now: float) -> list[bytes]:
        """Work until nothing is left to do; what is to be sent."""
        sent: list[bytes] = []
        worker = await self._parts.pool.lend()
        try:
            for _ in range(ROUNDS):
                claim = await self._claim(servo, now)
                if claim is None:
                    break
                sent += await self._finished(claim, now, worker)
        except WorkerLost as lost:
            await self._parts.pool.replace(worker, str(lost))
            raise Refused(Refusal.UNAVAILABLE, _AGAIN) from None
        except BaseException:
            self._parts.pool.take_back(worker)
            raise
        self._parts.pool.take_back(worker)
        return sent

    async def _claim(self, servo: str, now: float) -> Lease | None:
        store = self._parts.store
        try:
            found = await self._parts.shelf.ask(
                lambda: store.lease(self._owner, 1, LEASE_S, now, tuple(MessageKind), servo=servo)
            )
        except StoreUnavailable:
            raise Refused(Refusal.UNAVAILABLE, _AGAIN) from None
        return found[0] if found else None

    async def _finished(self, claim: Lease, now: float, worker: Worker) -> tuple[bytes, ...]:
        outcome = await self._dispatcher.finish(claim, now, worker)
        if outcome is None:
            raise Refused(Refusal.UNAVAILABLE, _AGAIN)
        return outcome.outgoing
