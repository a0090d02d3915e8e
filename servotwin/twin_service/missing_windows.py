"""Windows that never came: holes in the sequences of a boot, for which the edge is asked once."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice

from servotwin.messages import Resend, WindowMessage, encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.soundness import missing_windows
from servotwin.store.store import Store
from servotwin.twin_service.limits import MAX_SERVOS
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.store_executor import StoreExecutor

log = logging.getLogger(__name__)

_PATIENCE_S = 30.0
"""s that a window may be late behind a newer one, which overtook it on the way or after an outage."""
_LOOK_S = 5.0
_BOOTS = 50
"""Boots that are looked at together: after a start all are due."""
_REASON = "windows of this boot did not come"
Boot = tuple[str, str]
"""(servo, boot)."""


@dataclass(slots=True)
class _Progress:
    """Of a boot: highest sequence that came, highest one that was asked for, time of the next look (s, monotonic)."""

    newest: int
    asked: int = -1
    look_at: float | None = None


class SequenceWatch:
    """Notes the sequences of new windows, and says which boots are due for a look into the store.

    Parameters
    ----------
    monotonic : callable
        s.
    """

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._now = monotonic
        self._boots: OrderedDict[Boot, _Progress] = OrderedDict()

    def note(self, window: WindowMessage) -> None:
        """Note a new window. One that an edge has selected tells nothing: those before it were not sent."""
        if window.response_version is not None:
            return
        boot = window.servo, window.boot
        known = self._boots.get(boot)
        if known is None:
            # What the store has of this boot is not known yet, after a restart of the twin or of the edge.
            known = self._boots[boot] = _Progress(window.sequence, look_at=self._now() + _PATIENCE_S)
            if len(self._boots) > MAX_SERVOS:
                self._boots.popitem(last=False)
        if window.sequence > known.newest + 1 and known.look_at is None:
            known.look_at = self._now() + _PATIENCE_S
        known.newest = max(known.newest, window.sequence)
        self._boots.move_to_end(boot)

    def due(self) -> list[Boot]:
        """Boots whose sequences are to be looked at, some at a time; each is returned once."""
        now = self._now()
        due = (boot for boot, known in self._boots.items() if known.look_at is not None and known.look_at <= now)
        boots = list(islice(due, _BOOTS))
        for boot in boots:
            self._boots[boot].look_at = None
        return boots

    def to_ask(self, boot: Boot, missing: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Those of the missing ranges that were not asked for yet; from now on they were."""
        known = self._boots.get(boot)
        if known is None:
            return []
        new = [(max(first, known.asked + 1), last) for first, last in missing if last > known.asked]
        if new:
            known.asked = new[-1][1]
        return new


class MissingWindows:
    """Asks edges for windows that did not come.

    Parameters
    ----------
    store, executor : Store, StoreExecutor
    sequences : SequenceWatch
    notify : callable
        Called with a servo that has a new outgoing message.
    metrics : Metrics
    wall : callable
        s since the epoch.
    """

    def __init__(
        self,
        store: Store,
        executor: StoreExecutor,
        sequences: SequenceWatch,
        notify: Callable[[str], None],
        metrics: Metrics,
        wall: Callable[[], float],
    ) -> None:
        self._store, self._executor, self._sequences = store, executor, sequences
        self._notify, self._metrics, self._wall = notify, metrics, wall

    async def run(self) -> None:
        """Look for holes every few seconds."""
        while True:
            await asyncio.sleep(_LOOK_S)
            await self.look()

    async def look(self) -> None:
        """Ask for what is missing of the boots that are due."""
        for servo, boot in self._sequences.due():
            with suppress(StoreUnavailable):
                missing = await self._executor.run(partial(missing_windows, self._store, servo, boot))
                if new := self._sequences.to_ask((servo, boot), missing):
                    await self._ask(servo, boot, new)

    async def _ask(self, servo: str, boot: str, missing: list[tuple[int, int]]) -> None:
        first, last = missing[0][0], missing[-1][1]
        number = sum(1 + end - begin for begin, end in missing)
        self._metrics.missing.add(by=number)
        about = {"servo": servo, "boot": boot, "first": first, "last": last, "windows": number}
        log.warning("windows missing", extra=about)
        body = encode(Resend(servo, boot, first, last, _REASON))
        await self._executor.run(partial(self._store.post, {servo: body}, self._wall()))
        self._notify(servo)
