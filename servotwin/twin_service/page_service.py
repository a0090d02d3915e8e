"""The part of the service that people look at: the pages' data, live views and simulated what-ifs."""

from __future__ import annotations

from collections.abc import Callable

from servotwin.store.engine import POSTGRESQL, sqlite_file
from servotwin.store.store import Store
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.fleet_feed import FleetFeed
from servotwin.twin_service.fleet_process import ChangeReader
from servotwin.twin_service.fleet_reader import EdgePresence, FleetReader
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_dashboard import DashboardApi
from servotwin.twin_service.http_live import LiveApi
from servotwin.twin_service.http_parquet import ParquetApi
from servotwin.twin_service.http_what_if import WhatIfApi
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.live_views import LiveIntake, LiveViews
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.twin_file import TwinFile
from servotwin.twin_service.what_if_process import WhatIfProcess

_READERS = 2
"""Threads that read the store for the dashboard and the operators."""


class PageService:
    """Service of what the dashboard's pages ask for, apart from the work for the machines.

    Parameters
    ----------
    twin : TwinFile
    store : Store
    damage : callable
        Fault of the store; empty: there is none.
    presence : EdgePresence
    claims : EdgeClaims
        Tells which edge may stream samples.
    clocks : Clocks
    shared : bool
        Other processes write to the same database.
    executor : StoreExecutor
        Notes damage that a reader meets.

    Attributes
    ----------
    readers : StoreExecutor
        What people read may take long: edges and acknowledgements do not wait behind it.
    fleet, changes, feed : FleetReader, ChangeReader, FleetFeed
        Rows of the fleet's page, those that have changed, and the stream of them.
    live_intake : LiveIntake
        Takes what edges stream while someone watches.
    what_if : WhatIfProcess
        Simulates what a page asks for.
    """

    def __init__(
        self,
        twin: TwinFile,
        store: Store,
        damage: Callable[[], str],
        presence: EdgePresence,
        claims: EdgeClaims,
        clocks: Clocks,
        shared: bool,
        executor: StoreExecutor,
    ) -> None:
        self._config, self._store, self._monotonic = twin.service, store, clocks.monotonic
        self.readers = StoreExecutor(_READERS, "readers", executor.note_damage)
        self.fleet = FleetReader(store, presence, clocks.wall)
        self.changes = ChangeReader(self.fleet, self.readers, _readable_elsewhere(store))
        self.feed = FleetFeed(self.changes, presence, self._config.watchers, shared, damage)
        self._live_views = LiveViews(self._monotonic, presence, self._config.watchers, self._config.long_polls)
        self.live_intake = LiveIntake(claims, self._live_views, self._monotonic)
        self.what_if = WhatIfProcess(twin.start, self._monotonic)

    def routes(self, gate: EdgeGate, operators: OperatorAccess) -> list[HttpRoute]:
        """Routes of the dashboard, of live views, what-ifs and Parquet files."""
        machine_metrics = self._config.machine_metrics
        parts = (
            DashboardApi(operators, self._store, self.readers, self.fleet, self.feed, machine_metrics),
            WhatIfApi(operators, self._store, self.readers, self.what_if, self._monotonic),
            LiveApi(gate, operators, self.live_intake, self._live_views),
            ParquetApi(operators, self._store, self.readers, self.what_if),
        )
        return [route for part in parts for route in part.routes()]

    def end_streams(self) -> None:
        """End all live views and event streams, which would otherwise keep the server from stopping."""
        self.feed.close()
        self._live_views.close()

    async def stop(self) -> None:
        """Stop the processes that read and simulate."""
        await self.what_if.stop()
        await self.changes.stop()

    def close(self) -> None:
        """Close the threads that read, after all requests."""
        self.readers.close()


def _readable_elsewhere(store: Store) -> str | None:
    """URL with which another process reads the store, password included; None: it is in this one's memory."""
    url = store.engines.reader.url
    inside = url.get_backend_name() != POSTGRESQL and sqlite_file(url) is None
    return None if inside else url.render_as_string(hide_password=False)
