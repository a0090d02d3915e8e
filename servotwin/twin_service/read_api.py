"""What operators read: servos, windows, the evidence chain; and what machines watch."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import msgspec
from fastapi import Request, Response

from servotwin.messages import NAME_PATTERN, Refusal
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import Backlog, StoredEvidence, WindowTrace
from servotwin.store.store import Store
from servotwin.twin_service.auth import Authority
from servotwin.twin_service.edge_api import MSGPACK, seconds, token_of, whole
from servotwin.twin_service.metrics import CONTENT_TYPE, Metrics
from servotwin.twin_service.refused import Refused
from servotwin.twin_service.shelf import Shelf

MOST = 1000
FRESH_S = 0.5
"""s for which a count of what waits is told again."""
Health = Callable[[], dict[str, Any]]
"""What is well: "ok" as a whole, and why."""


class ReadApi:
    """Everything that only reads.

    Parameters
    ----------
    authority : Authority
    store : Store
    shelf : Shelf
    health : callable
    metrics : Metrics
    wall : callable
        s since the epoch.
    """

    def __init__(
        self,
        authority: Authority,
        store: Store,
        shelf: Shelf,
        health: Health,
        metrics: Metrics,
        wall: Callable[[], float],
    ) -> None:
        self._authority, self._store, self._shelf = authority, store, shelf
        self._health, self._metrics, self._wall = health, metrics, wall
        self._counting = asyncio.Lock()
        self._count: tuple[float, Backlog | None] = -math.inf, None
        metrics.watch("servotwin_waiting", "Messages and proofs not yet worked on.", self._numbers, "kind")
        metrics.watch("servotwin_waiting_seconds", "For how long the oldest message waits.", self._age)

    async def servos(self, request: Request) -> Response:
        """Every servo that was heard of, by name; `after` a name, `limit` at most."""
        self._authority.admit_operator(token_of(request))
        after, limit = request.query_params.get("after", ""), _limit(request)
        if after and not re.match(NAME_PATTERN, after):
            raise Refused(Refusal.NOT_UNDERSTOOD, "after: give the name of a servo")
        found = await self._ask(partial(self._store.servos, after, limit))
        return as_json([each._asdict() for each in found])

    async def servo(self, request: Request) -> Response:
        """One servo."""
        servo = self._named(request)
        found = await self._ask(partial(self._store.servo, servo))
        if found is None:
            raise Refused(Refusal.UNKNOWN_SERVO, f"servo {servo!r} was never heard of")
        return as_json(found._asdict())

    async def audit(self, request: Request) -> Response:
        """Its windows and all that followed from them, newest first."""
        servo = self._named(request)
        since = seconds(request, "since", 0.0) or None
        before = whole(request, "before", 0) or None
        found = await self._ask(partial(self._store.audit, servo, since, _limit(request), None, before))
        return as_json([told(link) for link in found])

    async def events(self, request: Request) -> Response:
        """What belongs to no window of it, newest first."""
        servo = self._named(request)
        since = seconds(request, "since", 0.0)
        found = await self._ask(partial(self._store.events, servo, since, _limit(request)))
        return as_json([shown(each) for each in found])

    async def window(self, request: Request) -> Response:
        """A window as it came, and what it was compressed with."""
        servo = self._named(request)
        boot, sequence = request.path_params["boot"], _sequence(request.path_params["sequence"])
        if not re.match(NAME_PATTERN, boot):
            raise Refused(Refusal.NOT_UNDERSTOOD, "boot: is no boot's name")
        found = await self._ask(partial(self._store.window, servo, boot, sequence))
        if found is None or not found.body:
            raise Refused(Refusal.NOT_UNDERSTOOD, "this window is not kept", 404)
        headers = {"content-encoding": found.encoding} if found.encoding else {}
        return Response(found.body, 200, headers, MSGPACK)

    async def health(self, _request: Request) -> Response:
        """Whether all is well: 200, or 503; and how much waits."""
        found = self._health()
        try:
            found["waiting"] = (await self._counted())._asdict()
        except StoreUnavailable:
            found["ok"] = found["store"] = False
        return as_json(found, 200 if found["ok"] else 503)

    async def metrics(self, _request: Request) -> Response:
        """Prometheus' text format."""
        with suppress(StoreUnavailable):  # then the numbers are those of before
            await self._counted()
        return Response(self._metrics.text(), media_type=CONTENT_TYPE)

    def _numbers(self) -> Mapping[str, float]:
        found = self._count[1]
        return {} if found is None else {"messages": found.messages, "proofs": found.proofs}

    def _age(self) -> float:
        found = self._count[1]
        return math.nan if found is None else found.age

    async def _counted(self) -> Backlog:
        """How much waits; counted now and then only, as anybody may ask, and as often as he likes."""
        async with self._counting:
            at, found = self._count
            if found is None or self._wall() - at >= FRESH_S:
                found = await self._shelf.ask(lambda: self._store.backlog(self._wall()))
                self._count = self._wall(), found
            return found

    def _named(self, request: Request) -> str:
        """The servo of the address, for an operator."""
        self._authority.admit_operator(token_of(request))
        servo: str = request.path_params["servo"]
        if not re.match(NAME_PATTERN, servo):
            raise Refused(Refusal.NOT_UNDERSTOOD, "servo: is no servo's name")
        return servo

    async def _ask(self, call: Callable[[], Any]) -> Any:
        try:
            return await self._shelf.ask(call)
        except StoreUnavailable:
            raise Refused(Refusal.UNAVAILABLE, "the store cannot be read now") from None


def as_json(value: Any, status: int = 200) -> Response:
    """An answer in JSON."""
    return Response(msgspec.json.encode(value), status, media_type="application/json")


def told(link: WindowTrace) -> dict[str, Any]:
    """A link of the evidence chain, what lies in it as MessagePack opened."""
    return {
        "window": link.window._asdict(),
        "found": [shown(each) for each in link.found],
        "steps": [
            {
                "update": shown(step.update),
                "answers": [shown(each) for each in step.answers],
                "effect": None
                if step.effect is None
                else {
                    "window": step.effect.window._asdict(),
                    "before": None if step.effect.before is None else shown(step.effect.before),
                    "after": shown(step.effect.after),
                },
            }
            for step in link.steps
        ],
    }


def shown(found: StoredEvidence) -> dict[str, Any]:
    """A piece of evidence, its body opened."""
    return {**found._asdict(), "body": _opened(found.body)}


def _opened(body: bytes) -> Any:
    try:
        return msgspec.msgpack.decode(body)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def _limit(request: Request) -> int:
    return min(whole(request, "limit", 100) or 1, MOST)


def _sequence(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 16):
        raise Refused(Refusal.NOT_UNDERSTOOD, "sequence: is no whole number")
    return int(text)
