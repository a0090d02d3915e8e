"""A clock that is behind the store's newest message: it is wrong now, or was when that message came."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial

from servotwin.store.clock_gaps import newest_receipt
from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import Store
from servotwin.twin_service.store_executor import StoreExecutor

log = logging.getLogger(__name__)

_APART_S = 60.0
"""s by which clocks of several processes on one store may differ."""


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
        self._fault = ""

    def sentences(self) -> list[str]:
        """Return a sentence where the clock was behind the store at the start."""
        return [self._fault] if self._fault else []

    async def tell(self, announce: Callable[[str, str], None]) -> None:
        """Compare, and log and announce the sentence."""
        with suppress(StoreUnavailable):
            newest, now = await self._executor.run(partial(newest_receipt, self._store)), self._wall()
            if newest <= now + _APART_S:
                return
            self._fault = (
                f"the clock said {_date(now)} at the start, and the store's newest message came on {_date(newest)}: "
                "set the clock if it is wrong, and restart the twin"
            )
            log.warning("clock behind the store", extra={"why": self._fault})
            announce("clock behind the store", self._fault)


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M UTC")
