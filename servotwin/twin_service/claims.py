"""One live edge per servo, at the twin: which claim counts, and the conflict of an edge that was superseded."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from servotwin.link.claim import HeldClaim
from servotwin.messages import PROTOCOL, ClaimStatus, EdgeClaim, Refusal
from servotwin.messages.claims import CLONED
from servotwin.store.claims import StoredClaim
from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import Store
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.limits import MAX_SERVOS, RequestRejected
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.store_executor import StoreExecutor, unavailable

log = logging.getLogger(__name__)

_FRESH_S = 1.0
"""s for which a claim that was read counts where other processes of the service may have accepted a newer one."""
_KIND = "alarm"
"""Kind of the evidence of a conflict."""
_SUPERSEDED = "another edge of this servo has taken over"
_OF_COPIES = 2
"""Windows under names that are taken by which a run has a copy: one alone may have been changed on its way."""


class _Known(NamedTuple):
    """Newest claim as it was read, and when (s, monotonic)."""

    claim: StoredClaim
    at: float


class EdgeClaims:
    """Refuses the requests of edges that were superseded.

    A request without a claim is of an edge of a version that had none: it passes.

    Parameters
    ----------
    store, executor : Store, StoreExecutor
    evict : callable
        Ends the polls of a servo, which may be of an edge that was superseded just now.
    metrics : Metrics
    clocks : Clocks
    shared : bool
        Other processes write the store too.
    software : str
        Version of servotwin.
    announce : callable
        Called with the kind and the sentence of an alarm, and the servo.
    samples_per_window, bytes_per_day : int
        Limits that edges are told; 0: none.
    """

    def __init__(
        self,
        store: Store,
        executor: StoreExecutor,
        evict: Callable[[str], None],
        metrics: Metrics,
        clocks: Clocks,
        shared: bool,
        software: str,
        announce: Callable[[str, str, str], None],
        samples_per_window: int = 0,
        bytes_per_day: int = 0,
    ) -> None:
        self._samples_per_window, self._bytes_per_day = samples_per_window, bytes_per_day
        self._store, self._executor, self._evict, self._metrics = store, executor, evict, metrics
        self._clocks, self._shared, self._software, self._announce = clocks, shared, software, announce
        self._known: OrderedDict[str, _Known] = OrderedDict()
        self._reported: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._conflicts: OrderedDict[tuple[str, str], set[int]] = OrderedDict()

    async def check(self, servo: str, text: str) -> None:
        """Check the claim that a request names; "": none.

        Raises
        ------
        RequestRejected
            SUPERSEDED: another edge has taken over. NOT_UNDERSTOOD: the text is no claim. UNAVAILABLE.
        """
        if not text:
            return
        held = HeldClaim.from_text(text)
        if held is None:
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, "the claim is none: a number and the name of a run")
        newest = await self._newest(servo)
        if held.number > newest.number:
            # The store is older than the edge's claim: it was restored from a backup.
            new = StoredClaim(held.run, held.number)
            newest = await self._write(servo, partial(self._store.raise_claim, servo, new, new.number))
        if (held.run, held.number) != newest:
            raise RequestRejected(Refusal.SUPERSEDED, _SUPERSEDED)

    async def answer(self, servo: str, claim: EdgeClaim) -> ClaimStatus:
        """Answer a question or a claim; raises RequestRejected as `check` does."""
        if claim.servo != servo:
            raise RequestRejected(Refusal.OTHER_NAME, f"the claim is of servo {claim.servo!r}, not of {servo!r}")
        self._known.pop(servo, None)
        newest = await self._newest(servo)
        if claim.takes and claim.run != newest.run:
            # Only the number after the newest: of two that claim at once one wins, and a repeated claim does nothing.
            if claim.takes == newest.number + 1:
                before, newest = newest, await self._take(servo, StoredClaim(claim.run, claim.takes), newest)
                if claim.behind and newest.run == claim.run:
                    await self._report_behind(servo, claim, before)
        elif claim.held and claim.run != newest.run and claim.held <= newest.number:
            await self._report(servo, claim, newest)
        limits = self._samples_per_window, self._bytes_per_day
        return ClaimStatus(servo, newest.run, newest.number, PROTOCOL, self._software, *limits)

    async def conflicting(self, servo: str, boot: str, sequence: int) -> None:
        """Report a window that came under the name of another one, as of a computer that was cloned while it ran.

        Once the servo's live run has sent several, a copy of it runs, which has its claim too. Neither counts then, and
        both fall back: nothing tells which of them moves the machine.

        Raises
        ------
        RequestRejected
            SUPERSEDED: they do not count any more. UNAVAILABLE.
        """
        log.warning("window in conflict", extra={"servo": servo, "boot": boot, "sequence": sequence})
        found = self._conflicts.setdefault((servo, boot), set())
        if not found:
            await self._tell_conflict(servo, f"another window came under the name {boot}/{sequence} of a stored one")
        if len(found) < _OF_COPIES:
            found.add(sequence)
        if len(self._conflicts) > MAX_SERVOS:
            self._conflicts.popitem(last=False)
        newest = await self._newest(servo)
        if len(found) < _OF_COPIES or boot != newest.run:
            return
        new = StoredClaim(CLONED, newest.number + 1)
        if await self._write(servo, partial(self._store.raise_claim, servo, new, new.number)) == new:
            self._evict(servo)
            await self._tell_conflict(
                servo,
                f"two copies of the run {boot} send, as of a computer that was cloned while it ran; neither counts "
                "until one of them is started again",
            )
        raise RequestRejected(Refusal.SUPERSEDED, _SUPERSEDED)

    async def _tell_conflict(self, servo: str, what: str) -> None:
        sentence = f"conflict: {what}"
        self._announce("conflict", sentence, servo)
        await self._write(servo, lambda now: self._store.add_alarm(sentence, now, servo))
        self._metrics.evidence.add(_KIND)

    async def _take(self, servo: str, new: StoredClaim, before: StoredClaim) -> StoredClaim:
        newest = await self._write(servo, partial(self._store.raise_claim, servo, new, new.number))
        if newest == new:
            log.info("edge began", extra={"servo": servo, "run": new.run, "claim": new.number, "before": before.run})
            self._evict(servo)
        return newest

    async def _report(self, servo: str, claim: EdgeClaim, newest: StoredClaim) -> None:
        """Report that an edge runs which was superseded: at each of its questions, and once in the evidence."""
        self._metrics.rejected.add(Refusal.SUPERSEDED.value)
        log.warning("conflict", extra={"servo": servo, "run": claim.run, "newer": newest.run})
        if newest.run == CLONED:  # which was told
            return
        sentence = f"conflict: two edges of this servo run, {claim.run} and {newest.run}; the newer one counts"
        self._announce("conflict", sentence, servo)
        if (servo, claim.run) in self._reported:
            return
        await self._write(servo, lambda now: self._store.add_alarm(sentence, now, servo))
        self._metrics.evidence.add(_KIND)
        self._reported[servo, claim.run] = None
        if len(self._reported) > MAX_SERVOS:
            self._reported.popitem(last=False)

    async def _report_behind(self, servo: str, claim: EdgeClaim, before: StoredClaim) -> None:
        """Report an edge whose folder knows nothing of the run before."""
        log.warning("folder behind", extra={"servo": servo, "run": claim.run, "before": before.run})
        sentence = (
            f"the edge's run {claim.run} began in a folder that knows nothing of the run {before.run} before it: an "
            "older folder was put back, or a copy started; what waited for the twin in the other one is not in it"
        )
        self._announce("folder behind", sentence, servo)
        await self._write(servo, lambda now: self._store.add_alarm(sentence, now, servo))
        self._metrics.evidence.add(_KIND)

    async def _newest(self, servo: str) -> StoredClaim:
        known = self._known.get(servo)
        if known is not None and not (self._shared and self._clocks.monotonic() - known.at > _FRESH_S):
            return known.claim
        at = self._clocks.monotonic()
        try:
            claim = await self._executor.run(partial(self._store.claim_of, servo))
        except StoreUnavailable as error:
            raise unavailable(error, "the store cannot be read now") from None
        self._note(servo, claim, at)
        return claim

    async def _write(self, servo: str, call: Callable[..., StoredClaim | None]) -> StoredClaim:
        """Write to the store at the present time; return the newest claim."""
        at = self._clocks.monotonic()
        try:
            claim = await self._executor.run(lambda: call(now=self._clocks.wall()))
        except StoreUnavailable as error:
            raise unavailable(error, "the store cannot be written now") from None
        if claim is None:
            return await self._newest(servo)
        self._note(servo, claim, at)
        return claim

    def _note(self, servo: str, claim: StoredClaim, at: float) -> None:
        # Never an older one: a slow read may end after a write.
        known = self._known.get(servo)
        if known is None or known.claim.number <= claim.number:
            self._known[servo] = _Known(claim, at)
        self._known.move_to_end(servo)
        if len(self._known) > MAX_SERVOS:
            self._known.popitem(last=False)
