"""Processes on one store, killed with SIGKILL at any time: acknowledged writes are stored, and stored once."""

import multiprocessing
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import NamedTuple, TextIO

import pytest
import sqlalchemy as sa
import store_process
from store_cases import NewAddress, window

from servotwin.store.engine import transaction
from servotwin.store.records import PutResult
from servotwin.store.schema import evidence, messages
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

# Its processes begin with the store imported, which takes longer than what they do.
SERVER = multiprocessing.get_context("forkserver")
IMPORTED = ["servotwin.store.store", "servotwin.store.group_commit", "psycopg", "pytest"]
IMPORTED += ["sqlalchemy.dialects.postgresql.psycopg", "sqlalchemy.dialects.sqlite.pysqlite"]
FAR = 4e9
"""s since the epoch: every lease is over."""


class Started(NamedTuple):
    """A process on a store, and its output."""

    process: BaseProcess
    output: TextIO


@contextmanager
def process(role: str, url: str) -> Iterator[Started]:
    """One that is killed when the block ends."""
    SERVER.set_forkserver_preload(IMPORTED)
    reading, writing = SERVER.Pipe(duplex=False)
    started = SERVER.Process(target=store_process.main, args=(role, url, writing))
    started.start()
    writing.close()
    with reading, os.fdopen(os.dup(reading.fileno()), encoding="utf-8") as output:
        try:
            yield Started(started, output)
        finally:
            kill(Started(started, output))
            started.join()
            started.close()


def kill(started: Started) -> None:
    """Send SIGKILL."""
    started.process.kill()


def lines(started: Started, number: int) -> list[list[str]]:
    """So many lines of its output."""
    result = [line.split() for _, line in zip(range(number), started.output, strict=False)]
    assert len(result) == number, "the process ended by itself"
    return result


def rest(started: Started) -> list[list[str]]:
    """Remaining lines of a killed process, without a last one that was cut off."""
    return [line.split() for line in started.output if line.endswith("\n")]


def finish(store: Store) -> None:
    """Work through everything that is left."""
    while result := store.lease("finisher", 16, 1.0, FAR):
        assert all(store.commit([store_process.worked(one) for one in result], FAR))


def numbers(store: Store, column: sa.Column) -> Counter[int]:
    with transaction(store.engines.reader) as connection:
        return Counter(connection.scalars(sa.select(column)))


def check_each_once(store: Store) -> None:
    """Every message has led to one piece of evidence and one letter."""
    known = numbers(store, messages.c.id)
    assert known
    assert numbers(store, evidence.c.message) == known
    posted = Counter(
        int(post.body.split()[1]) for servo in store.servos() for post in store.outgoing(servo.servo, 0, 10**6)
    )
    assert posted == known
    for servo in store.servos():
        serials = [post.serial for post in store.outgoing(servo.servo, 0, 10**6)]
        assert serials == list(range(1, servo.posted + 1))


@pytest.mark.slow
def test_killed_in_the_middle_of_group_commits(new_address: NewAddress) -> None:
    url = new_address()
    safe: set[tuple[str, int]] = set()
    open_store(url).close()
    for acknowledged in (1, 150, 37):
        with process("put", url) as writing, process("work", url) if "postgres" in url else no_process() as working:
            output = lines(writing, len(safe) + acknowledged)
            kill(writing)
            output += rest(writing)
            if working is not None:
                lines(working, 1)
        safe |= {(servo, int(sequence)) for _, servo, sequence in output}
        store = open_store(url)
        assert set(store.put([window(servo, n, store_process.BODY) for servo, n in sorted(safe)])) == {PutResult.KNOWN}
        store.close()
    store = open_store(url)
    finish(store)
    check_each_once(store)
    assert all(store.window(servo, "boot", n).body == store_process.BODY for servo, n in safe)
    store.close()


@contextmanager
def no_process() -> Iterator[None]:
    """SQLite has one twin process."""
    yield None


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_of_results(new_address: NewAddress) -> None:
    url = new_address()
    store = open_store(url)
    store.put([window(servo, n) for n in range(60) for servo in store_process.SERVOS])
    for outcomes in (1, 4, 2):
        with process("work", url) as working:
            lines(working, outcomes)
    finish(store)
    check_each_once(store)
    store.close()


@pytest.mark.slow
def test_the_leases_of_a_killed_process_go_to_another_one(new_address: NewAddress) -> None:
    url = new_address()
    store = open_store(url)
    store.put([window(servo, n) for n in range(12) for servo in store_process.SERVOS])
    with process("hold", url) as holding:
        assert [words[0] for words in lines(holding, 2)] == ["HELD", "HELD"]
    with process("work", url) as working:
        while store.backlog(0.0).messages:
            lines(working, 1)
    check_each_once(store)
    store.close()


@pytest.mark.slow
def test_two_processes_share_the_work_and_one_is_killed(new_address: NewAddress) -> None:
    url = new_address()
    store = open_store(url)
    store.put([window(servo, n) for n in range(60) for servo in store_process.SERVOS])
    with process("work", url) as one, process("work", url) as other:
        lines(one, 2)
        kill(one)
        while store.backlog(0.0).messages:
            lines(other, 1)
    check_each_once(store)
    store.close()
