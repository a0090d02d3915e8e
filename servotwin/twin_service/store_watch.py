"""Watch over the store's integrity: at the start, and in the background all the time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from threading import Event
from typing import TypeVar

from servotwin.messages import Resend, encode
from servotwin.messages.checks import LARGEST_REPORTED
from servotwin.runtime.files import replace_file
from servotwin.store.claims import LOST_ANSWERS
from servotwin.store.engine import StoreDamaged, StoreUnavailable
from servotwin.store.integrity import (
    IntegrityReport,
    check_all,
    check_bodies,
    check_files,
    check_pages,
    fault_of_servo,
    newest_message,
    read_error,
)
from servotwin.store.migrate import newer_revision
from servotwin.store.outgoing import fresh_serial
from servotwin.store.records import Incoming, OutgoingMessage, PutResult, WorkResult
from servotwin.store.schema import REVISION
from servotwin.store.store import Store
from servotwin.store.stored_value import WrongRow, WrongValue
from servotwin.twin_service.limits import MAX_SERVOS
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.store_mark import loss, mark_file, read_mark

log = logging.getLogger(__name__)

_Record = TypeVar("_Record", Incoming, WorkResult)
_Result = TypeVar("_Result")

_START_S, _PAGES_S = 5.0, 60.0
"""s for which pages are checked at the start, and once per round in the background."""
_BODIES, _SHARE = 32, 0.02
"""Bodies that are compared at once, and the share of the time for that."""
_RECHECK_S, _LONGEST_RECHECK_S, _RECHECK_SHARE = 5.0, 600.0, 0.1
"""s between two checks of a store that was found damaged: the first ones, and at most, unless a check takes longer; and
their share of the time below that."""
_MARK_S = 5.0
"""s between two notes of the newest message: as many acknowledged messages may go unnoticed if the log is lost."""
_TELL_S = 1.0
_NEW_S = 10.0
"""s between two looks for servos that are new to a store that has lost messages."""
_AHEAD_S = 3600.0
"""s for which an edge that has had more than the store sent is not asked once more."""
_MAX_SERIAL = LARGEST_REPORTED
"""Largest serial that an edge may report as received; messages carry serials up to twice that."""
_LOST = "the twin's store has lost messages"
_ASIDE = "is set aside, and its edge keeps its windows, because its record is damaged"
_REMEDY = "put that right as the operator's guide says (A servo is set aside)"


class StoreWatch:
    """Checks the store, and keeps a damaged one from being written.

    Where a check of everything finds nothing wrong but rows of a few servos, it sets these aside, and the store is
    written again for all others; their rows are looked at again and again, and those that are sound come back.

    Parameters
    ----------
    store, executor : Store, StoreExecutor
    put, commit : callable
        Commit a message, and a work result.
    wall, monotonic : callable
        s.
    beside : Path
        File beside which the newest message is noted where the store is no file: the twin's own.

    Attributes
    ----------
    fault, lost : str
        Damage that was found, until a check of everything passes; messages that the store had and has no more; empty:
        none.
    rounds : int
        Number of times that everything was checked.
    """

    def __init__(
        self,
        store: Store,
        executor: StoreExecutor,
        put: Callable[[Incoming], Awaitable[PutResult]],
        commit: Callable[[WorkResult], Awaitable[bool]],
        wall: Callable[[], float],
        monotonic: Callable[[], float],
        beside: Path,
    ) -> None:
        self._store, self._executor = store, executor
        self._mark_file = mark_file(store, beside)
        self._put, self._commit = put, commit
        self._wall, self._monotonic = wall, monotonic
        self._marked, self._not_marked = 0, ""
        self._asked, self._ahead = set[str](), dict[str, float]()
        self._why, self._read_error = "", ""
        self.fault, self.lost, self.rounds = "", "", 0
        self._newer = ""
        self._read_wrong, self._again = False, 0
        self._logged_aside: Mapping[str, WrongRow] = {}

    @property
    def aside(self) -> dict[str, str]:
        """Servos that are set aside, each with a clause on its first wrong row."""
        return {servo: wrong.clause for servo, wrong in self._store.aside.items()}

    def sentences(self) -> list[str]:
        """Return a sentence for each servo that is set aside, and one where a newer servotwin migrated the store."""
        aside = self.aside.items()
        return [*(f"servo {servo!r} {_ASIDE}: {why}; {_REMEDY}" for servo, why in aside), *self._newer_sentences()]

    def _newer_sentences(self) -> list[str]:
        if not self._newer:
            return []
        return [
            f"a newer servotwin has migrated the store to schema {self._newer} while this twin, which knows "
            f"{REVISION}, runs: end this twin, and install the newer servotwin"
        ]

    async def put(self, item: Incoming) -> PutResult:
        """Commit a message, unless the store is damaged, or its servo set aside; raises StoreUnavailable."""
        return await self._guarded(self._put, item)

    async def commit(self, result: WorkResult) -> bool:
        """Commit a work result, likewise; False: it is void."""
        return await self._guarded(self._commit, result)

    async def _guarded(self, write: Callable[[_Record], Awaitable[_Result]], record: _Record) -> _Result:
        self._store.require_sound(record.servo)
        try:
            return await write(record)
        except StoreDamaged as error:
            self._was_read(error)
            raise

    async def start(self) -> None:
        """Check the pages for a short time, and if messages are missing that the store once had."""
        self._log_aside()
        with suppress(StoreUnavailable):
            self._found(await self._executor.run(partial(check_pages, self._store, _START_S), slow=True))
            if not self.fault:
                await self._executor.run(self._compare_mark)

    async def run(self) -> None:
        """Check everything, again and again, at a small share of the time."""
        after = 0
        while True:
            begun = self._monotonic()
            if not self.fault:
                with suppress(StoreUnavailable):
                    after = await self._executor.run(partial(self._check_some, after), slow=True)
            await asyncio.sleep(max(1.0, (self._monotonic() - begun) * (1.0 / _SHARE - 1.0)))

    async def run_recheck(self) -> None:
        """Check a store that was found damaged again and again, ever more rarely; one that is sound is written again.

        A disk that does not give a page for a while is over some day, and to SQLite that is damage.
        """
        pause = _RECHECK_S
        while True:
            await asyncio.sleep(_TELL_S)
            self._log_aside()
            if self._executor.damage is not None:
                self._was_read(self._executor.damage)
            begun = self._monotonic()
            if not self.fault:
                pause = _RECHECK_S
                if self._store.aside:
                    with suppress(StoreUnavailable):
                        await self._executor.run(self._look_aside, slow=True)
                    await asyncio.sleep((self._monotonic() - begun) * (1.0 / _RECHECK_SHARE - 1.0))
                continue
            with suppress(StoreUnavailable):
                await self.recheck()
            if self.fault:
                took = self._monotonic() - begun
                longest = max(took, _LONGEST_RECHECK_S)
                await asyncio.sleep(min(longest, max(pause, took * (1.0 / _RECHECK_SHARE - 1.0))))
                pause = min(2.0 * pause, _LONGEST_RECHECK_S)

    async def recheck(self) -> None:
        """Check everything of a damaged store, however long it takes; where it is sound, go on.

        Go on without a few servos where nothing else is wrong.

        Raises
        ------
        StoreUnavailable
        """
        ended = Event()
        try:
            error = await self._executor.run(partial(read_error, self._store), slow=True)
            if error and error != self._read_error:
                log.error("the disk does not give the store", extra={"why": error})
            self._read_error = error
            if error:
                self.fault = f"the disk does not give it: {error}"
                return
            report = await self._executor.run(partial(check_all, self._store, ended.is_set), slow=True)
            if report.faults and report.faults[0] != self.fault:  # who reads finds a column, and this its row too
                self.fault, self._why = report.faults[0], "; ".join(report.faults)
                log.error("damage of the store", extra={"why": self._why})
            if report.complete and (not report.faults or self._can_go_on(report.rows)):
                await self._executor.run(partial(self._resume, report.rows))
        except asyncio.CancelledError:
            self._store.engines.opened.cut()  # a statement of PostgreSQL's knows nothing of the end
            raise
        finally:
            ended.set()  # where this task was cancelled, its thread still checks

    def _can_go_on(self, wrong: Sequence[WrongRow]) -> bool:
        """True where the store works without these rows; not where they are read again although they are set aside.

        Once is allowed in a round of checks: whoever began to read before they were set aside may end after that.
        """
        same = self._read_wrong and self._store.aside.keys() == {row.servo for row in wrong}
        self._again = self._again + 1 if same else 0
        return bool(wrong) and self._again <= 1

    def _resume(self, wrong: Sequence[WrongRow] = ()) -> None:
        """Write the store again but for the servos of wrong rows, over connections that have read nothing damaged."""
        self._store.engines.dispose()
        self._store.set_aside(wrong)  # first: from here on nobody reads or writes those rows
        self.fault, self._executor.damage, self._store.damaged, self._read_wrong = "", None, False, False
        self._log_aside()
        if wrong:
            log.warning("store written again, but for servos that are set aside", extra={"after": self._why})
        else:
            log.warning("store sound again: it is written", extra={"after": self._why})
        self._compare_mark()

    def _look_aside(self) -> None:
        """Take back those servos whose rows are sound now."""
        for wrong in self._store.aside.values():
            if not fault_of_servo(self._store, wrong):
                self._store.take_back(wrong)
        self._log_aside()

    def _log_aside(self) -> None:
        """Log servos that were set aside or taken back since the last call, by this twin or another one."""
        before, self._logged_aside = self._logged_aside, self._store.aside
        for servo in sorted(self._logged_aside.keys() - before.keys()):
            log.error("servo set aside", extra={"servo": servo, "why": self._logged_aside[servo].clause})
        for servo in sorted(before.keys() - self._logged_aside.keys()):
            log.warning("servo sound again", extra={"servo": servo, "after": before[servo].clause})

    async def run_mark(self) -> None:
        """Note the newest message beside the store every few seconds, and look at the store's schema."""
        while True:
            await asyncio.sleep(_MARK_S)
            if not self.fault:
                with suppress(StoreUnavailable):
                    await self._executor.run(self.mark)
                    self._newer = await self._executor.run(partial(newer_revision, self._store.engines.reader))

    async def run_lost(self, notify: Callable[[str], None]) -> None:
        """Ask edges that are new to a store which has lost messages: it may have lost their servos too.

        `notify` is called with each that was asked, so that its poll ends.
        """
        while True:
            await asyncio.sleep(_NEW_S)
            if self.lost and not self.fault:
                with suppress(StoreUnavailable):
                    for servo in await self._executor.run(self._ask_for_windows):
                        notify(servo)

    async def tell(self, announce: Callable[..., None]) -> None:
        """Announce, once, that the store has lost messages, is damaged or of a newer servotwin, or lacks a servo."""
        told, damage, newer, aside = "", "", list[str](), frozenset[str]()
        while True:
            for servo in sorted(self.aside.keys() - aside):
                announce("servo set aside", f"the servo {_ASIDE}: {self.aside[servo]}; {_REMEDY}", servo)
            aside = frozenset(self.aside)
            if self._newer_sentences() != newer:
                newer = self._newer_sentences()
                for sentence in newer:
                    log.error("store of a newer servotwin", extra={"why": sentence})
                    announce("store of a newer servotwin", sentence)
            if self.lost != told:
                told = self.lost
                announce("the store has lost messages", told)
            if bool(self.fault) != bool(damage):
                damage = self.fault
                if damage:
                    announce("store damaged", f"it is not written any more: {damage}")
            await asyncio.sleep(_TELL_S)

    def outgoing(self, servo: str, after: int) -> tuple[Sequence[OutgoingMessage], str]:
        """Messages to the edge with serials above `after`, and what the store lacks in a sentence; empty: nothing.

        An edge that has had a higher serial than any that was posted had it from a store that was put back since, or
        from another one: nothing beside the store need tell, where a whole folder was put back. It is asked for the
        windows that it still keeps, with a serial that it does not take for a duplicate.
        """
        messages = self._store.outgoing(servo, after)
        if messages or not after or self.fault:  # of an edge that received nothing no store is too old
            return messages, ""
        posted = self._store.posted([servo]).get(servo, 0)
        if not posted < after <= _MAX_SERIAL:
            return messages, ""
        if self._monotonic() - self._ahead.get(servo, -inf) < _AHEAD_S:
            self._store.skip_to_serial(servo, after)  # of two twins behind one address each finds it ahead in turns
            return messages, ""
        if len(self._ahead) >= MAX_SERVOS:
            self._ahead.clear()
        self._ahead[servo] = self._monotonic()
        log.error("the store has lost messages", extra={"servo": servo, "had": after, "has": posted})
        sentence = (
            f"the edge has had message {after}, and the newest one of the store is {posted}: the store was put back, "
            f"or is another one. {LOST_ANSWERS}"
        )
        now = self._wall()
        self._store.add_alarm(sentence, now, servo)
        self._store.post({servo: encode(Resend(servo, reason=_LOST))}, now, above=max(after, fresh_serial(now)))
        return self._store.outgoing(servo, after), sentence

    def mark(self) -> None:
        """Note the newest message; where the store had a newer one, a database was put back while this ran."""
        newest = 0 if self._mark_file is None else newest_message(self._store)
        if self._mark_file is None or newest == self._marked:
            return
        if newest < self._marked:
            self._lost(self._marked, newest)
        try:
            replace_file(self._mark_file, b"%d\n" % newest, durable=True, mode=0o600)
            self._marked, self._not_marked = newest, ""
        except OSError as error:
            if str(error) != self._not_marked:  # each reason once: a log fills a full disk too
                log.warning("newest message not noted", extra={"why": str(error)})
            self._not_marked = str(error)

    def _compare_mark(self) -> None:
        noted, newest = read_mark(self._mark_file), newest_message(self._store)
        if loss(noted, newest):
            self._lost(noted, newest)

    def _lost(self, had: int, has: int) -> None:
        """Ask all edges for the windows that they still keep: the store lacks messages that it once had."""
        log.error("the store has lost messages", extra={"had": had, "has": has})
        self.lost = loss(had, has)
        self._asked.clear()
        self._ask_for_windows()

    def _ask_for_windows(self) -> set[str]:
        """Ask those edges for the windows that they still keep that were not asked yet; return them.

        The hole in the evidence is said there: nothing else shows what the edges do not send again.
        """
        new, now = self._servos() - self._asked, self._wall()
        self._store.add_alarm(f"the store has lost messages: {self.lost}. {LOST_ANSWERS}", now, *new)
        asked = {servo: encode(Resend(servo, reason=_LOST)) for servo in new}
        self._store.post(asked, now, above=fresh_serial(now))  # edges ignore serials up to the last one that they got
        self._asked |= new
        return new

    def _servos(self) -> set[str]:
        names, after = set[str](), ""
        while summaries := self._store.servos(after):
            after = summaries[-1].servo
            names.update(one.servo for one in summaries)
        return names

    def _check_some(self, after: int) -> int:
        """Check the next bodies, and the pages where a round ends; returns the id of the last one, 0 after a round."""
        self._found(check_files(self._store))
        result, last = check_bodies(self._store, after, _BODIES, self._store.aside)
        self._found(result)
        if not result.complete:
            return last
        self._found(check_pages(self._store, _PAGES_S))
        self.rounds, self._again = self.rounds + 1, 0
        return 0

    def _was_read(self, error: StoreDamaged) -> None:
        """Note damage that a reader or a writer met."""
        self._read_wrong = self._read_wrong or isinstance(error.__cause__, WrongValue)
        self._found(IntegrityReport((str(error),), False))

    def _found(self, result: IntegrityReport) -> None:
        known = result.rows and {row.servo for row in result.rows} <= self._store.aside.keys()
        if result.faults and not self.fault and not known:
            self.fault, self._store.damaged = result.faults[0], True
            self._why, self._read_error = "; ".join(result.faults), ""
            log.error("store damaged: it is not written any more", extra={"why": self._why})
