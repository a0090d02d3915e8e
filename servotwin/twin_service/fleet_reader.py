"""Rows of the fleet from the store, and which edges hold a connection to this process."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.dashboard.fleet import ALARMS_S, FleetRow, context_key, fleet_row
from servotwin.store import overview, queries
from servotwin.store.overview import StorePosition
from servotwin.store.store import Store

_CONTEXTS = 1000
"""Texts of contexts in memory."""
_PAGE = 1000
_GRACE_S = 5.0
"""s between two polls of an edge that counts as connected."""


class FleetPage(NamedTuple):
    """Rows by name, the position of the store at which they were read, and the twin's time, s since the epoch."""

    rows: list[FleetRow]
    position: StorePosition
    now: float


class EdgePresence:
    """Edges that hold a connection to this process.

    Parameters
    ----------
    waiting : callable
        Names of the servos whose edges wait for a message now.
    only_here : bool
        True where an edge cannot be connected in another way: not over MQTT, nor to another twin process.
    monotonic : callable
        s.
    """

    def __init__(self, waiting: Callable[[], Iterable[str]], only_here: bool, monotonic: Callable[[], float]) -> None:
        self._waiting, self._only_here, self._monotonic = waiting, only_here, monotonic
        self._seen: dict[str, float] = {}

    def refresh(self) -> frozenset[str]:
        """Names of the servos whose edges are connected."""
        now = self._monotonic()
        self._seen = {servo: at for servo, at in self._seen.items() if now - at < _GRACE_S}
        self._seen.update(dict.fromkeys(self._waiting(), now))
        return frozenset(self._seen)

    def connected(self) -> tuple[tuple[str, ...], bool]:
        """Servos whose edges are connected, and True where all others are not."""
        return tuple(sorted(self.refresh())), self._only_here

    def links(self) -> dict[str, object]:
        """The same, for an event."""
        connected, sole = self.connected()
        return {"connected": connected, "sole": sole}

    def __call__(self, servo: str) -> bool | None:
        """True, False, or None where it cannot be known."""
        here = self._monotonic() - self._seen.get(servo, -math.inf) < _GRACE_S or servo in self._waiting()
        return True if here else False if self._only_here else None


class FleetReader:
    """Reads rows of the fleet; blocks, so that it runs in a thread.

    Parameters
    ----------
    store : Store
    presence : callable
        Tell whether an edge is connected, as `EdgePresence` does.
    wall : callable
        s since the epoch.
    """

    def __init__(self, store: Store, presence: Callable[[str], bool | None], wall: Callable[[], float]) -> None:
        self._store, self._presence, self._wall = store, presence, wall
        self._contexts: dict[str, str] = {}

    def page(self, after: str, limit: int) -> FleetPage:
        """Rows of the servos whose names follow `after`."""

        def read(connection: sa.Connection) -> FleetPage:
            position = overview.position(connection)  # before the rows: what changes meanwhile is sent once more
            rows = self._rows(connection, overview.names_after(connection, after, limit, self._store.aside))
            return FleetPage(rows, position, self._wall())

        return self._store.reading(read)

    def all(self) -> list[FleetRow]:
        """Rows of all servos, by name."""
        rows: list[FleetRow] = []
        while page := self.page(rows[-1].servo if rows else "", _PAGE).rows:
            rows += page
        return rows

    def now(self) -> float:
        """Present time, s since the epoch."""
        return self._wall()

    def position(self) -> StorePosition:
        """Present position of the store."""
        return self._store.reading(overview.position)

    def rows(self, servos: Collection[str]) -> list[FleetRow]:
        """Rows of these servos; unknown ones are left out."""
        return self._store.reading(lambda connection: self._rows(connection, servos))

    def changed(self, since: StorePosition, limit: int) -> tuple[list[str], StorePosition]:
        """Names of the servos that changed after a position, `limit` at most, and the present position."""

        def read(connection: sa.Connection) -> tuple[list[str], StorePosition]:
            position = overview.position(connection)
            return ([] if position == since else overview.changed(connection, since, limit)), position

        return self._store.reading(read)

    def _rows(self, connection: sa.Connection, servos: Collection[str]) -> list[FleetRow]:
        facts = overview.facts(connection, self._store.sound(servos), self._wall() - ALARMS_S)
        missing = {context_key(each) for each in facts} - self._contexts.keys() - {""}
        if missing:
            found = queries.contexts(connection, missing)
            kept = {} if len(self._contexts) + len(found) > _CONTEXTS else self._contexts
            self._contexts = {**kept, **found}  # replaced, not changed: other threads read it
        contexts = self._contexts
        return [fleet_row(each, contexts, self._presence(each.summary.servo)) for each in facts]
