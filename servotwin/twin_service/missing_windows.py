"""Windows that never came: holes in the sequences of a boot, for each of which the edge is asked once."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice

from servotwin.messages import Resend, WindowMessage, encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.integrity import missing_windows
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
_RANGES = 8
"""Requests to an edge at once; the last one asks for windows in between too."""
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
    held : callable
        True where a servo's edge waits before it sends older windows, because the twin has asked it to.
    """

    def __init__(self, monotonic: Callable[[], float], held: Callable[[str], bool] = lambda _servo: False) -> None:
        self._now, self._held = monotonic, held
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
        if window.sequence < known.newest and known.look_at is not None:
            known.look_at = self._now() + _PATIENCE_S  # what an outage has held up still comes
        known.newest = max(known.newest, window.sequence)
        self._boots.move_to_end(boot)

    def due(self) -> list[Boot]:
        """Boots whose sequences are to be looked at, some at a time; each is due until `looked_at`."""
        now = self._now()
        due = (boot for boot, known in self._boots.items() if known.look_at is not None and known.look_at <= now)
        return list(islice((boot for boot in due if not self._held(boot[0])), _BOOTS))

    def newest(self, boot: Boot) -> int:
        """Highest sequence of a boot that came; -1: none is known."""
        known = self._boots.get(boot)
        return -1 if known is None else known.newest

    def to_ask(self, boot: Boot, missing: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Those of the missing ranges that were not asked for yet."""
        known = self._boots.get(boot)
        if known is None:
            return []
        return [(max(first, known.asked + 1), last) for first, last in missing if last > known.asked]

    def asked(self, boot: Boot, last: int) -> None:
        """Note that the missing windows up to a sequence were asked for."""
        if (known := self._boots.get(boot)) is not None:
            known.asked = max(known.asked, last)

    def looked_at(self, boot: Boot, newest: int) -> None:
        """Note that everything up to a sequence was asked for: the next look is due after the next hole.

        Where later windows came meanwhile, or the look failed (`newest` is -1), it is due once more after a while.
        """
        if (known := self._boots.get(boot)) is not None:
            known.look_at = None if known.newest == newest else self._now() + _PATIENCE_S


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
    announce : callable
        Called with the kind and the sentence of an alarm, and the servo.
    """

    def __init__(
        self,
        store: Store,
        executor: StoreExecutor,
        sequences: SequenceWatch,
        notify: Callable[[str], None],
        metrics: Metrics,
        wall: Callable[[], float],
        announce: Callable[[str, str, str], None],
    ) -> None:
        self._store, self._executor, self._sequences = store, executor, sequences
        self._notify, self._metrics, self._wall, self._announce = notify, metrics, wall, announce

    async def run(self) -> None:
        """Look for holes every few seconds."""
        while True:
            await asyncio.sleep(_LOOK_S)
            await self.look()

    async def look(self) -> None:
        """Ask for what is missing of the boots that are due; what fails is tried again later."""
        for boot in self._sequences.due():
            newest = self._sequences.newest(boot)
            try:
                missing = await self._executor.run(partial(missing_windows, self._store, *boot))
                # A hole before a window that came during the look may be that of an edge that is about to fill it.
                missing = [hole for hole in missing if hole[1] < newest]
                for first, last in _few(self._sequences.to_ask(boot, missing)):
                    await self._ask(boot, first, last)
            except StoreUnavailable:
                newest = -1
            self._sequences.looked_at(boot, newest)

    async def _ask(self, boot: Boot, first: int, last: int) -> None:
        body = encode(Resend(*boot, first, last, _REASON))
        await self._executor.run(partial(self._store.post, {boot[0]: body}, self._wall()))
        self._sequences.asked(boot, last)
        number = 1 + last - first
        self._metrics.missing.add(by=number)
        about = {"servo": boot[0], "boot": boot[1], "first": first, "last": last, "windows": number}
        log.warning("windows missing", extra=about)
        these = f"window {first} of boot {boot[1]}" if first == last else f"windows {first} to {last} of boot {boot[1]}"
        self._announce("windows missing", f"{these} did not come, although later ones did", boot[0])
        self._notify(boot[0])


def _few(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Ranges of which the last one contains all that are over the limit."""
    return [*ranges[: _RANGES - 1], *((ranges[_RANGES - 1][0], ranges[-1][1]) for _ in ranges[_RANGES - 1 : _RANGES])]
