"""Group commit: few transactions, results only once they are safe, and recovery from every failure."""

import asyncio
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, wait
from pathlib import Path

import pytest
import sqlalchemy as sa
from sqlalchemy import event
from store_cases import letter, outcome, window

from servotwin.errors import InvalidInput
from servotwin.store.engine import ServoSetAside, StoreBusy, StoreUnavailable, transaction
from servotwin.store.group_commit import AwaitedCommits, CommitLimits, GroupCommit
from servotwin.store.records import EvidenceRecord, Incoming, PutResult, WorkResult
from servotwin.store.store import Store, open_store
from servotwin.store.stored_value import WrongRow

PATIENCE_S = 60.0
FULL = "database or disk is full"


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = open_store(str(tmp_path / "store.db"))
    yield opened
    opened.close()


@pytest.fixture
def group(store: Store) -> Iterator[GroupCommit]:
    started = GroupCommit(store, clock=lambda: 300.0)
    yield started
    started.close()


class Gate:
    """A store whose transactions wait until they are let through, and are counted."""

    def __init__(self, store: Store) -> None:
        self.store, self.opened, self.entered = store, threading.Event(), threading.Event()
        self.sizes: list[int] = []
        self.name = store.name

    def write(
        self, items: Sequence[Incoming], made: Sequence[WorkResult], now: float
    ) -> tuple[list[PutResult], list[bool]]:
        self.sizes.append(len(items) + len(made))
        self.entered.set()
        assert self.opened.wait(PATIENCE_S)
        return self.store.write(items, made, now)


@pytest.fixture
def gate(store: Store) -> Iterator[Gate]:
    made = Gate(store)
    yield made
    made.opened.set()


def results(futures: Sequence[Future[PutResult]]) -> list[PutResult]:
    return [future.result(PATIENCE_S) for future in futures]


@pytest.mark.slow
def test_messages_and_results_of_many_threads(store: Store, group: GroupCommit) -> None:
    store.put([window("worked")])
    (claim,) = store.lease("me", 1, 30.0, 200.0)
    became: list[PutResult] = []

    def send(servo: str) -> None:
        became.extend(group.put(window(servo, n % 20)).result(PATIENCE_S) for n in range(40))

    threads = [threading.Thread(target=send, args=(f"s{k}",)) for k in range(8)]
    for thread in threads:
        thread.start()
    assert group.commit(outcome(claim, outgoing=(b"u",))).result(PATIENCE_S) is True
    assert group.commit(outcome(claim)).result(PATIENCE_S) is False
    for thread in threads:
        thread.join()
    assert (became.count(PutResult.NEW), became.count(PutResult.KNOWN)) == (160, 160)
    assert store.servo("worked").posted == 1


def test_waiting_writes_are_committed_together(gate: Gate) -> None:
    group = GroupCommit(gate, CommitLimits(together=8))
    first = group.put(window(sequence=0))
    assert gate.entered.wait(PATIENCE_S)
    others = [group.put(window(sequence=n)) for n in range(1, 12)]
    assert not first.done()
    gate.opened.set()
    assert results([first, *others]) == [PutResult.NEW] * 12
    assert gate.sizes == [1, 8, 3]
    group.close()


def test_writes_wait_for_others_until_there_are_enough(gate: Gate) -> None:
    gate.opened.set()
    group = GroupCommit(gate, CommitLimits(gather=10.0 * PATIENCE_S, enough=3))
    futures = [group.put(window(sequence=n)) for n in range(3)]
    assert results(futures) == [PutResult.NEW] * 3
    last = group.put(window(sequence=3))
    group.close()  # does not wait any longer
    assert last.result(0.0) is PutResult.NEW
    assert gate.sizes == [3, 1]


def test_a_write_alone_waits_for_no_longer_than_the_limit(gate: Gate) -> None:
    gate.opened.set()
    group = GroupCommit(gate, CommitLimits(gather=0.02))
    begun = time.monotonic()
    assert group.put(window(sequence=0)).result(PATIENCE_S) is PutResult.NEW
    assert time.monotonic() - begun >= 0.02
    group.close()


def test_without_a_limit_nothing_waits_for_others(gate: Gate) -> None:
    group = GroupCommit(gate, CommitLimits(gather=0.0))
    first = group.put(window(sequence=0))
    assert gate.entered.wait(PATIENCE_S)
    others = [group.put(window(sequence=n)) for n in (1, 2)]
    gate.opened.set()
    assert results([first, *others]) == [PutResult.NEW] * 3
    assert group.put(window(sequence=3)).result(PATIENCE_S) is PutResult.NEW
    group.close()
    assert gate.sizes == [1, 2, 1]


def test_a_transaction_is_bounded_in_bytes(gate: Gate) -> None:
    group = GroupCommit(gate, CommitLimits(together_bytes=2000))
    futures = [group.put(window(sequence=0))]
    assert gate.entered.wait(PATIENCE_S)
    futures += [group.put(window(sequence=n, body=bytes(1000))) for n in range(1, 6)]
    gate.opened.set()
    results(futures)
    assert gate.sizes == [1, 2, 2, 1]
    group.close()


@pytest.mark.parametrize("bounds", [CommitLimits(waiting=3), CommitLimits(waiting_bytes=3 * 7)])
def test_a_full_queue_refuses_messages_but_not_results(gate: Gate, bounds: CommitLimits) -> None:
    gate.store.put([window("worked")])
    (claim,) = gate.store.lease("me", 1, 30.0, 200.0)
    group = GroupCommit(gate, bounds)
    futures = [group.put(window(sequence=0))]
    assert gate.entered.wait(PATIENCE_S)
    futures += [group.put(window(sequence=n)) for n in range(1, 4)]
    with pytest.raises(StoreBusy, match="3 messages wait"):
        group.put(window(sequence=4))
    committed = group.commit(outcome(claim))
    assert group.waiting == 4
    gate.opened.set()
    assert results(futures) == [PutResult.NEW] * 4
    assert committed.result(PATIENCE_S) is True
    assert results([group.put(window(sequence=4))]) == [PutResult.NEW]
    group.close()


def test_an_accepted_write_cannot_be_cancelled(gate: Gate) -> None:
    group = GroupCommit(gate)
    futures = [group.put(window(sequence=n)) for n in range(3)]
    assert not any(future.cancel() for future in futures)
    gate.opened.set()
    assert results(futures) == [PutResult.NEW] * 3
    group.close()


def test_closing_commits_waiting_writes_and_refuses_new_ones(gate: Gate) -> None:
    group = GroupCommit(gate)
    futures = [group.put(window(sequence=n)) for n in range(20)]
    gate.opened.set()
    group.close()
    assert all(future.done() for future in futures)
    assert gate.store.servo("a").windows == 20
    with pytest.raises(StoreUnavailable, match="is being closed"):
        group.put(window())


def test_an_invalid_result_fails_alone(store: Store, gate: Gate) -> None:
    store.put([window("a"), window("b")])
    a, b = sorted(store.lease("me", 2, 30.0, 200.0))
    group = GroupCommit(gate)
    futures = [group.put(letter("c"))]
    assert gate.entered.wait(PATIENCE_S)
    faulty = group.commit(outcome(a, EvidenceRecord("estimate", 0, b"", context="nowhere")))
    futures.append(group.put(letter("d")))
    valid = group.commit(outcome(b))
    gate.opened.set()
    assert results(futures) == [PutResult.NEW] * 2
    assert valid.result(PATIENCE_S) is True
    assert isinstance(faulty.exception(PATIENCE_S), sa.exc.IntegrityError)
    assert (store.servo("a").serial, store.servo("b").serial) == (0, 1)
    group.close()


def test_of_a_batch_only_the_messages_of_a_servo_that_is_set_aside_in_that_moment_are_refused(
    store: Store, gate: Gate
) -> None:
    store.put([window("a"), window("b")])
    a, b = sorted(store.lease("me", 2, 30.0, 200.0))
    group = GroupCommit(gate)
    futures = [group.put(letter("c"))]
    assert gate.entered.wait(PATIENCE_S)
    refused = [group.put(letter("a")), group.commit(outcome(a))]
    futures += [group.put(letter("b")), group.put(letter("d"))]
    valid = group.commit(outcome(b))
    store.set_aside([WrongRow("a", "")])
    gate.opened.set()
    assert results(futures) == [PutResult.NEW] * 3
    assert valid.result(PATIENCE_S) is True
    for future in refused:
        with pytest.raises(ServoSetAside, match="record of servo 'a' is damaged"):
            future.result(PATIENCE_S)
    assert gate.sizes == [1, 5, 3]
    group.close()


def test_a_message_of_a_servo_that_is_set_aside_says_nothing_about_the_store(store: Store, group: GroupCommit) -> None:
    writes = AwaitedCommits(group)
    store.set_aside([WrongRow("a", "")])

    async def refused() -> None:
        with pytest.raises(ServoSetAside):
            await writes.put(window("a"))

    asyncio.run(refused())
    assert writes.failure == ""


def limit_pages(store: Store, more: int | None) -> None:
    """Let the database grow by so many pages; None: by as many as it likes."""
    with transaction(store.engines.writer) as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {2**31 if more is None else pages + more}")


def test_a_full_disk_fails_the_writes_and_the_store_recovers(store: Store, group: GroupCommit) -> None:
    assert results([group.put(window(sequence=0))]) == [PutResult.NEW]
    limit_pages(store, 20)
    futures = [group.put(window(sequence=n, body=bytes(50_000))) for n in range(1, 30)]
    wait(futures, PATIENCE_S)
    errors = [error for future in futures if (error := future.exception()) is not None]
    assert errors
    assert all(isinstance(error, StoreUnavailable) and FULL in str(error) for error in errors)
    safe = [n for n, future in enumerate(futures, 1) if future.exception() is None]
    assert store.servo("a").windows == 1 + len(safe)
    limit_pages(store, None)
    again = results([group.put(window(sequence=n, body=bytes(50_000))) for n in range(1, 30)])
    assert again == [PutResult.KNOWN if n in safe else PutResult.NEW for n in range(1, 30)]


def test_a_full_disk_loses_no_result_that_was_acknowledged(store: Store, group: GroupCommit) -> None:
    store.put([window()])
    (claim,) = store.lease("me", 1, 30.0, 200.0)
    limit_pages(store, 2)
    large = outcome(claim, outgoing=(bytes(200_000),))
    assert isinstance(group.commit(large).exception(PATIENCE_S), StoreUnavailable)
    assert store.servo("a").serial == 0
    limit_pages(store, None)
    assert group.commit(large).result(PATIENCE_S) is True
    assert [len(post.body) for post in store.outgoing("a", 0)] == [200_000]


def test_a_read_only_database_is_survived(store: Store, group: GroupCommit) -> None:
    with transaction(store.engines.writer) as connection:
        connection.exec_driver_sql("PRAGMA query_only = ON")
    with pytest.raises(StoreUnavailable, match="readonly") as refused:
        results([group.put(window())])
    assert str(refused.value).startswith(f"store {store.name}: not available now")
    with transaction(store.engines.reader) as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM messages").scalar_one() == 0
    store.engines.writer.dispose()
    assert results([group.put(window())]) == [PutResult.NEW]


def test_results_that_cannot_be_written_are_a_failure_although_messages_can(store: Store, group: GroupCommit) -> None:
    """As without a right on a table of results: the store counted as available, at each window anew."""
    now = 1000.0

    async def write(writes: AwaitedCommits) -> None:
        nonlocal now
        await writes.put(window())
        (claim,) = store.lease("me", 1, 60.0, 200.0)
        _break(store, "evidence")
        work = outcome(claim, EvidenceRecord("estimate", 1, b""))
        with pytest.raises(StoreUnavailable):
            await writes.commit(work)
        now += 1.0
        await writes.put(window(sequence=2))
        assert (writes.failed_at, "evidence" in writes.failure) == (1000.0, True)
        now += 60.0  # as where another process has done that work
        await writes.put(window(sequence=3))
        assert writes.failure == ""

    asyncio.run(write(AwaitedCommits(group, lambda: now)))


def _break(store: Store, table: str) -> None:
    with transaction(store.engines.writer) as connection:
        connection.exec_driver_sql(f"ALTER TABLE {table} RENAME TO another")


def test_a_lost_connection_is_survived(store: Store, group: GroupCommit) -> None:
    failing = True

    def cut(*_: object) -> None:
        if failing:
            raise sa.exc.OperationalError("INSERT", None, OSError("connection was cut"))

    event.listen(store.engines.writer, "before_cursor_execute", cut)
    with pytest.raises(StoreUnavailable, match="connection was cut"):
        results([group.put(window())])
    failing = False
    assert results([group.put(window())]) == [PutResult.NEW]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MB, where one may be mounted."""
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("only root may mount a small disk; max_page_count stands in for it")
    disk = tmp_path / "disk"
    disk.mkdir()
    made = subprocess.run([mount, "-t", "tmpfs", "-o", "size=2m", "tmpfs", disk], check=False, capture_output=True)
    if made.returncode:
        pytest.skip("a small disk cannot be mounted here; max_page_count stands in for it")
    yield disk
    subprocess.run(["umount", "-l", disk], check=True)


def test_a_disk_that_is_really_full_and_then_really_read_only(small_disk: Path) -> None:
    store = open_store(str(small_disk / "store.db"))
    group = GroupCommit(store)
    hoard = small_disk / "hoard"
    hoard.write_bytes(bytes(1_200_000))
    futures = [group.put(window(sequence=n, body=os.urandom(50_000))) for n in range(40)]
    wait(futures, PATIENCE_S)
    errors = [error for future in futures if (error := future.exception()) is not None]
    assert errors
    assert all(isinstance(error, StoreUnavailable) for error in errors)
    hoard.unlink()
    assert results([group.put(window(sequence=100))]) == [PutResult.NEW]
    safe = 1 + sum(future.exception() is None for future in futures)
    assert store.servo("a").windows == safe
    group.close()
    store.close()
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    try:
        with pytest.raises(InvalidInput, match=r"readonly|unable to open"):
            open_store(str(small_disk / "store.db"))
    finally:
        subprocess.run(["mount", "-o", "remount,rw", small_disk], check=True)
    store = open_store(str(small_disk / "store.db"))
    assert store.servo("a").windows == safe
    store.close()
