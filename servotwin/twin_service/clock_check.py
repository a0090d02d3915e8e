"""A clock that is behind the store's newest message, or differs from that of PostgreSQL's server."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial

from servotwin.store.clock_gaps import newest_receipt, server_clock
from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import Store
from servotwin.twin_service.store_executor import StoreExecutor

log = logging.getLogger(__name__)

_APART_S = 2.0
"""s by which a clock may differ from the server's: of two processes that differ by twice that from each other, each
takes the other's leases for ended only where their renewals fail."""
_BEHIND_S = 60.0
"""s by which the clock may be behind the store's newest message."""


class ClockCheck:
    """Comparison of the clock with the store, at the start: from then on the service does not follow the clock.

    Parameters
    ----------
    store, executor : Store, StoreExecutor
    wall : callable
        s since the epoch.
    """

    def __init__(self, store: Store, executor: StoreExecutor, wall: Callable[[], float]) -> None:
        self._store, self._executor, self._wall = store, executor, wall
        self._faults: list[str] = []

    def sentences(self) -> list[str]:
        """Return a sentence on each fault of the clock at the start."""
        return list(self._faults)

    async def tell(self, announce: Callable[[str, str], None]) -> None:
        """Compare, and log and announce what is found."""
        with suppress(StoreUnavailable):
            # The server was asked between the two: a slow answer is no difference.
            before, server, now = await self._executor.run(
                lambda: (self._wall(), server_clock(self._store), self._wall())
            )
            if server is not None and not before - _APART_S <= server <= now + _APART_S:
                # Twins whose clocks differ take each other's leases for ended, and work on the same messages.
                fault = self._add(now, f"that of the database's server {_date(server)}: set the one that is wrong,")
                log.warning("clock differs from the database server's", extra={"why": fault})
                announce("clock differs from the database server's", fault)
            newest, now = await self._executor.run(partial(newest_receipt, self._store)), self._wall()
            if newest > now + _BEHIND_S:
                came = f"the store's newest message came on {_date(newest)}: set the clock if it is wrong,"
                fault = self._add(now, came)
                log.warning("clock behind the store", extra={"why": fault})
                announce("clock behind the store", fault)

    def _add(self, now: float, against: str) -> str:
        fault = f"the clock said {_date(now)} at the start, and {against} and restart the twin"
        self._faults.append(fault)
        return fault


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
