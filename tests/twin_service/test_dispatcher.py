"""The dispatcher with a scripted store, pool and commit: failures are counted and leases released."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence

from servotwin.messages import Setting, Update, encode
from servotwin.store.engine import ServoSetAside, StoreUnavailable
from servotwin.store.records import EvidenceRecord, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin_service import dispatcher as dispatching
from servotwin.twin_service.dispatcher import Dispatcher
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.pace import EstimateShare, VerificationQuota, WorkPace
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.worker import LeaseResult, WorkerLost, WorkerUrgency

DIES, FAILS, TAKES_LONG, DEFERS, UPDATES = b"dies", b"fails", b"takes long", b"defers", b"updates"
TIMES = {TAKES_LONG: 19.0, UPDATES: 7.0}
UPDATE = encode(Update("a", 1, 0, ("b0", 0), 20.0, 0.1, 0.01, (0.08, 0.12), "OK", Setting(1e-4), 60.0))


def claim(servo: str, body: bytes = b"", kind: MessageKind = MessageKind.WINDOW) -> Lease:
    return Lease(servo, b"", 0, (StoredMessage(1, kind, body, "", 0.0),))


class Lender:
    """A store that lends what it is told, one list after the other; and its workers."""

    def __init__(self, turns: Sequence[Sequence[Lease]]) -> None:
        self.turns = list(turns)
        self.leased: list[tuple[float, bool]] = []
        self.seen: list[tuple[str, int]] = []
        self.released: list[frozenset[str]] = []
        self.noted: list[tuple[str, str]] = []
        self.renewed: list[frozenset[str]] = []
        self.held: list[str] = []
        self.expected: list[float] = []
        self.free = True
        self.through = asyncio.Event()

    def lease(self, _owner, _limit, _lease, _now, kinds, *, estimate_first, **_more) -> list[Lease]:
        if MessageKind.VERIFICATION in kinds and self.turns[0][0].messages[0].kind is not MessageKind.VERIFICATION:
            return []
        self.leased.append((time.monotonic(), estimate_first))
        return list(self.turns.pop(0)) if self.turns else []

    def renew(self, _owner, servos, _until) -> None:
        self.renewed.append(servos)

    def hold(self, servo, _until) -> None:
        self.held.append(servo)

    def release(self, _owner, servos=None) -> None:
        """Of the store: the servos; of the pool: a worker."""
        self.free = True
        if servos is not None:
            self.released.append(servos)

    async def acquire(self) -> "Lender":
        if not self.turns:
            self.through.set()
            await asyncio.Event().wait()
        return self

    async def replace(self, _worker, _why) -> None:
        pass

    async def finish(self, tasks) -> None:
        while tasks:
            await asyncio.wait(tasks)

    async def work(
        self, claims: Sequence[Lease], _now: float, urgency: Sequence[WorkerUrgency] = ()
    ) -> AsyncIterator[LeaseResult]:
        self.expected += [expected for expected, *_ in urgency]
        for each in claims:
            self.seen.append((each.servo, each.attempts))
            body = each.messages[0].body
            if body == DIES:
                raise WorkerLost("it died")
            deferred = 1 if body == DEFERS else 0
            made = None if body == FAILS else WorkResult(each.servo, each.serial, b"", None, (1,), deferred=deferred)
            if body == UPDATES and made is not None:
                made = made._replace(evidence=(EvidenceRecord("redesign", 1, b""),), outgoing=(UPDATE,))
            while body == TAKES_LONG and not self.renewed:
                await asyncio.sleep(0.001)
            yield LeaseResult(made, "it failed", TIMES.get(body, 0.0))


def through(
    turns: Sequence[Sequence[Lease]],
    valid: bool = True,
    pace: WorkPace | None = None,
    slow_commits: bool = False,
    quota: VerificationQuota | None = None,
    aside: str = "",
) -> Lender:
    """All turns, one after the other; where `slow_commits`, with each job before the commit of the one before it."""

    async def commit(made: WorkResult) -> bool:
        if made.servo == aside:
            raise ServoSetAside(aside)
        await asyncio.sleep(0.2 if slow_commits else 0.0)
        return valid

    async def body() -> Lender:
        lender, shelf = Lender(turns), StoreExecutor()
        dispatcher = Dispatcher(
            store=lender,
            executor=shelf,
            pool=lender,
            commit=commit,
            notify=lambda _servo: None,
            metrics=Metrics(),
            clocks=Clocks(),
            owner="me",
            quota=quota or VerificationQuota(0.0),
            pace=pace or WorkPace(0.5),
            note=lambda lease, result: lender.noted.append((lease.servo, result.servo)),
        )

        async def one_by_one() -> "Lender":
            while dispatcher._tasks and not (slow_commits and lender.free):
                await asyncio.wait(dispatcher._tasks, timeout=0.001 if slow_commits else None)
            lender.free = False
            return await Lender.acquire(lender)

        lender.acquire = one_by_one
        running = asyncio.create_task(dispatcher.run())
        through = asyncio.create_task(lender.through.wait())
        await asyncio.wait({through, running}, timeout=30.0, return_when=asyncio.FIRST_COMPLETED)
        assert through.done() or running.result()  # the dispatcher ended: raise what ended it
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await dispatcher.stop()
        shelf.close()
        return lender

    return asyncio.run(body())


def test_the_lease_that_a_lost_worker_was_processing_counts_as_failed():
    poison = claim("b", DIES)
    lender = through([[claim("a", FAILS)], [claim("a"), poison], [claim("a"), poison]])
    assert lender.seen == [("a", 1), ("b", 1), ("a", 2), ("b", 2)]


def test_a_verification_that_kills_its_workers_is_counted_although_windows_succeed():
    verification, window = claim("a", DIES, MessageKind.VERIFICATION), claim("a")
    lender = through([[verification], [window], [verification], [window], [verification]])
    assert [attempts for _, attempts in lender.seen] == [1, 1, 2, 1, 3]


def test_a_verification_that_has_killed_its_worker_is_over():
    quota = VerificationQuota(6.0, workers=2)
    lender = through([[claim("a", DIES, MessageKind.VERIFICATION)], [claim("b")]], quota=quota)
    assert lender.seen == [("a", 1), ("b", 1)]
    assert quota.refill(1e9)


def test_a_job_that_was_not_full_waits_for_more_servos_and_a_full_one_does_not(monkeypatch):
    monkeypatch.setattr(dispatching, "_GATHER_S", 0.2)
    full = [claim(f"s{n}") for n in range(16)]
    times = [at for at, _ in through([[claim("a")], full, [claim("b")]]).leased]
    assert times[1] - times[0] >= 0.19
    assert times[2] - times[1] < 0.19


def test_an_estimate_comes_before_the_next_job_of_new_messages(monkeypatch):
    monkeypatch.setattr(dispatching, "_GATHER_S", 30.0)
    estimate = claim("a")._replace(estimate=True)
    leased = through([[claim("a", DEFERS)], [estimate]]).leased
    assert [first for _, first in leased] == [False, True]


def test_a_result_is_noted_once_it_is_committed_and_a_void_one_never():
    turns = [[claim("a")], [claim("b", FAILS)]]
    assert through(turns).noted == [("a", "a")]
    assert through(turns, valid=False).noted == []


def test_a_void_result_releases_no_lease():
    lender = through([[claim("a")], [claim("b", FAILS)], [claim("b")]], valid=False)
    assert [servos for servos in lender.released if "a" in servos] == []
    assert frozenset({"b"}) in lender.released


def test_a_lease_is_renewed_for_as_long_as_a_worker_is_at_work(monkeypatch):
    monkeypatch.setattr(dispatching, "LEASE_S", 0.01)
    lender = through([[claim("a"), claim("b", TAKES_LONG)]])
    assert set(lender.renewed) == {frozenset({"b"})}


def test_a_servo_that_took_long_lets_the_others_come_first(monkeypatch):
    monkeypatch.setattr(dispatching, "LEASE_S", 0.01)
    assert through([[claim("a"), claim("b", TAKES_LONG)]]).held == ["b"]


def test_a_letter_that_takes_no_time_tells_nothing_of_windows(monkeypatch):
    """After a quiet hour with letters alone a fleet's backlog would be asked for far too fast."""
    monkeypatch.setattr(dispatching, "LEASE_S", 0.01)
    pace = WorkPace()
    through([[claim("a", TAKES_LONG)], *([claim("b", kind=MessageKind.LETTER)] for _ in range(20))], pace=pace)
    assert pace.seconds == 19.0


def test_turns_that_take_a_moment_do_not_shorten_what_an_update_is_expected_to_take():
    """Otherwise each of them lowers the expectation, until the next update is begun and expires."""
    lender = through(
        [[claim("a", UPDATES)], [claim("b", UPDATES)], *([claim("b")] for _ in range(20)), [claim("c", UPDATES)]]
    )
    assert lender.expected == [0.0, 0.0, *[7.0] * 21]


def test_work_that_begins_before_the_last_is_committed_is_expected_to_take_as_long_as_that():
    lender = through([[claim(servo, UPDATES)] for servo in "abc"], slow_commits=True)
    assert lender.expected == [0.0, 0.0, 7.0]


def test_jobs_are_as_large_as_the_work_is_quick():
    pace = WorkPace()
    assert pace.servos == 16
    for _ in range(100):
        pace.note(0.1)
    assert pace.servos == 5
    pace.note(30.0)
    assert pace.servos == 1
    for _ in range(100):
        pace.note(0.001)
    assert pace.servos == 16


def test_deferred_estimates_get_a_quarter_of_the_time_while_new_messages_wait():
    share, spent = EstimateShare(), {True: 0.0, False: 0.0}
    for _ in range(1000):
        estimate = share.due
        seconds = 0.03 if estimate else 0.016
        share.note(seconds, estimate)
        spent[estimate] += seconds
    assert abs(spent[True] / sum(spent.values()) - 0.25) < 0.01
    for _ in range(1000):  # nothing else to do: that is not held against them for long
        share.note(0.03, True)
    waits = 0
    while not share.due:
        share.note(0.016, False)
        waits += 1
    assert 0.016 * waits < 5.0


def test_an_estimate_that_kills_its_workers_is_counted_although_glances_succeed():
    estimate, window = claim("a", DIES)._replace(estimate=True), claim("a")
    lender = through([[estimate], [window], [estimate], [window], [estimate]])
    assert [attempts for _, attempts in lender.seen] == [1, 1, 2, 1, 3]


def test_a_servo_waits_until_its_share_of_a_worker_is_not_exceeded():
    assert WorkPace(0.25).hold(2.0) == 6.0
    assert WorkPace(0.25).hold(0.01) == WorkPace(1.0).hold(60.0) == 0.0


def test_a_dispatcher_knows_why_it_gets_no_work_and_when_the_store_is_back(monkeypatch):
    lease, rest = Lender.lease, Dispatcher._rest
    faults, known = iter(["the disk is full", "the disk is full", "read-only"]), []
    resting_ones = []

    def away(self, *args, **more):
        for fault in faults:
            raise StoreUnavailable(fault)
        return lease(self, *args, **more)

    async def resting(self, seconds):
        known.append(self.away)
        resting_ones.append(self)
        await rest(self, seconds)

    monkeypatch.setattr(Lender, "lease", away)
    monkeypatch.setattr(Dispatcher, "_rest", resting)
    monkeypatch.setattr(dispatching, "_RETRY_S", 1e-3)
    through([[claim("ax-1")]])
    assert known[:3] == ["the disk is full", "the disk is full", "read-only"]
    assert resting_ones[-1].away == ""


def test_a_result_of_a_servo_that_is_set_aside_stops_nobody_else(monkeypatch):
    monkeypatch.setattr(dispatching, "_RETRY_S", 1e9)
    lender = through([[claim("ax-1")], [claim("ax-2")], [claim("ax-1")]], aside="ax-1")
    assert [servo for servo, _ in lender.noted] == ["ax-2"]
    assert lender.released == []
