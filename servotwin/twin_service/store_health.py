"""Health of the store, as the last reads and writes found it; told when they begin to fail, and when that is over."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable

from servotwin.store.engine import StoreUnavailable
from servotwin.store.group_commit import AwaitedCommits
from servotwin.twin_service.store_executor import StoreExecutor

log = logging.getLogger(__name__)

_UNHEALTHY_S = 60.0
"""s for which the store counts as unhealthy after a failed write, unless a later one succeeds."""
_STALLED_S = 12.0
"""s after which a store that does not answer is not available: it fails by itself where it waits 10 s for a lock, and
edges do not wait longer."""
_CUT_S = 60.0
"""s after which the connections of a store that does not answer are cut: a proxy that has swallowed a request keeps its
connection alive for ever, and nobody else would end the wait. A working server needs less for any call but a check."""
_LOOK_S, _LASTS_S, _OVER_S = 1.0, 5.0, 10.0
"""s between two looks; after which trouble is no moment's, and posted; without trouble after which it is over: on a
full disk reads succeed between writes that fail."""
_WRITE_S = 15.0
"""s between two writes that only tell that the store can be written: without edges that send nothing else would."""


class StoreHealth:
    """Health of a store that is not damaged.

    Parameters
    ----------
    executor : StoreExecutor
    writes : AwaitedCommits
    leases : callable
        Why the dispatcher cannot take work from the store; empty: it can.
    damage : callable
        Damage of the store, which is told elsewhere; empty: none.
    cut : callable
        Cuts the connections to the store.
    monotonic : callable
        s.
    """

    def __init__(
        self,
        executor: StoreExecutor,
        writes: AwaitedCommits,
        leases: Callable[[], str],
        damage: Callable[[], str],
        cut: Callable[[], None],
        monotonic: Callable[[], float],
    ) -> None:
        self._executor, self._writes, self._now = executor, writes, monotonic
        self._leases, self._damage, self._cut = leases, damage, cut
        self._last_cut = -math.inf
        self._logged = set[str]()
        self._posted, self._since, self._seen = False, 0.0, -math.inf
        self._damage_seen = -math.inf
        self._not_written = ""

    @property
    def trouble(self) -> str:
        """Reason for which the last read or write failed, or gets no answer; empty: none did, or long ago."""
        if self._damage():
            self._damage_seen = self._now()
            return ""
        # A write that failed because of damage says nothing once that is over; damage is looked at every second.
        since = max(self._now() - _UNHEALTHY_S, self._damage_seen + _LOOK_S)
        failed = self._writes.failure if self._writes.failed_at > since else ""
        return self._leases() or failed or self._not_written or self._executor.fault or self._stalled()

    @property
    def _waited(self) -> float:
        """Time for which the oldest call has waited, s."""
        return max(self._executor.waited, self._writes.waited)

    def _stalled(self) -> str:
        """A server that hangs, or a disk that does, gives no error."""
        if self._waited < _STALLED_S:
            return ""
        return f"the store has not answered for {_STALLED_S:g} s: its server, its disk or the network between hangs"

    def look(self, announce: Callable[[str, str], None]) -> None:
        """Log trouble, each reason once, since a log fills a full disk too; announce it once it lasts."""
        trouble, now = self.trouble, self._now()
        if self._waited >= _CUT_S and now - self._last_cut >= _CUT_S:
            self._last_cut = now
            self._cut()
        if trouble:
            self._since, self._seen = self._since if self._logged else now, now
            if trouble not in self._logged:
                self._logged.add(trouble)
                log.error("store not available", extra={"why": trouble})
            if not self._posted and now - self._since >= _LASTS_S:
                self._posted = True
                announce("store not available", f"{trouble}; windows are refused meanwhile, and edges keep them")
        elif self._logged and not self._writes.failure and now - self._seen >= _OVER_S:
            self._logged.clear()
            self._posted = False
            log.info("store available again")

    async def watch(self, announce: Callable[[str, str], None]) -> None:
        """Look again and again."""
        while True:
            self.look(announce)
            await asyncio.sleep(_LOOK_S)

    async def run_write(self, write: Callable[[], None]) -> None:
        """Write again and again, whatever else does."""
        while True:
            await self.try_write(write)
            await asyncio.sleep(_WRITE_S)

    async def try_write(self, write: Callable[[], None]) -> None:
        """Note the reason for which a write, such as `Store.write_nothing`, fails."""
        try:
            if not self._damage():
                await self._executor.run(write)
            self._not_written = ""
        except StoreUnavailable as error:
            self._not_written = str(error)
