"""A store that cannot be read or written is told, once, with the reason, and when it is back."""

import asyncio
import logging
import threading
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from service_system import MSGPACK, bearer, hello, served, twin_file

from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import Backlog
from servotwin.store.store import Store
from servotwin.twin_service import http_operator, store_health, store_watch
from servotwin.twin_service.store_health import StoreHealth

FULL = "the database cannot be used: database or disk is full"
KIND, MEANWHILE = "store not available", "; windows are refused meanwhile, and edges keep them"


class Watched:
    """Health of a store in the middle of a run, looked at once a second."""

    def __init__(self) -> None:
        self.now, self.leases, self.damage = 1000.0, "", ""
        self.reads, self.told = SimpleNamespace(fault="", waited=0.0), list[tuple[str, str]]()
        self.writes = SimpleNamespace(failure="", failed_at=-1e9, waited=0.0)
        self.cuts = 0
        self.health = StoreHealth(
            self.reads, self.writes, lambda: self.leases, lambda: self.damage, self.cut, lambda: self.now
        )

    def cut(self) -> None:
        self.cuts += 1

    def looked(self, seconds: int) -> None:
        for _ in range(seconds):
            self.now += 1.0
            self.health.look(lambda kind, sentence: self.told.append((kind, sentence)))


def lines(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    return [(each.message, getattr(each, "why", "")) for each in caplog.records if "available" in each.message]


def test_failed_writes_are_logged_at_once_posted_when_they_last_and_over_when_they_succeed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    watched = Watched()
    watched.looked(5)
    watched.writes.failure, watched.writes.failed_at = FULL, watched.now
    watched.looked(1)
    assert lines(caplog) == [(KIND, FULL)]
    assert not watched.told
    watched.looked(30)
    watched.writes.failed_at = watched.now  # the next window, likewise
    watched.looked(59)
    assert watched.told == [(KIND, FULL + MEANWHILE)]
    watched.looked(600)
    assert not watched.health.trouble
    assert len(lines(caplog)) == len(watched.told) == 1, "nothing was written since: nobody knows that it would succeed"
    watched.writes.failure, watched.writes.failed_at = "", -1e9
    watched.looked(20)
    assert lines(caplog) == [(KIND, FULL), ("store available again", "")]
    watched.leases = "read-only"
    watched.looked(20)
    assert watched.told[1:] == [(KIND, "read-only" + MEANWHILE)]


@pytest.mark.parametrize("which", ["reads", "writes"])
def test_connections_of_a_store_that_does_not_answer_for_a_minute_are_cut_once_a_minute(which: str) -> None:
    watched = Watched()
    getattr(watched, which).waited = 59.0
    watched.looked(300)
    assert watched.cuts == 0
    getattr(watched, which).waited = 60.0
    watched.looked(181)
    assert watched.cuts == 4
    getattr(watched, which).waited = 0.0
    watched.looked(300)
    assert watched.cuts == 4


def test_a_moments_trouble_is_not_posted_and_reads_that_succeed_in_between_are_no_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    watched = Watched()
    watched.reads.fault = "locked"
    watched.looked(2)
    watched.reads.fault = ""
    watched.looked(30)
    assert not watched.told
    caplog.clear()
    for _ in range(20):
        watched.reads.fault = FULL
        watched.looked(1)
        watched.reads.fault = ""
        watched.looked(4)
    assert lines(caplog) == [(KIND, FULL)]
    assert watched.told == [(KIND, FULL + MEANWHILE)]


@pytest.mark.parametrize("part", ["reads", "writes"])
def test_a_store_that_hangs_is_told_although_it_gives_no_error(caplog: pytest.LogCaptureFixture, part: str) -> None:
    caplog.set_level(logging.INFO)
    watched = Watched()
    calls = getattr(watched, part)
    for second in range(11):  # as long as it may wait for a lock
        calls.waited = float(second)
        watched.looked(1)
    assert not watched.health.trouble
    for second in range(12, 40):
        calls.waited = float(second)
        watched.looked(1)
    ((_, why),) = lines(caplog)
    assert "hangs" in why
    assert watched.told == [(KIND, why + MEANWHILE)]
    calls.waited = 0.0
    watched.looked(20)
    assert lines(caplog)[1:] == [("store available again", "")]


@pytest.mark.slow
def test_health_and_metrics_answer_while_the_store_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_operator, "_PATIENCE_S", 0.05)
    monkeypatch.setattr(store_health, "_STALLED_S", 0.1)
    released = threading.Event()

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, client), asyncio.timeout(60.0):
            backlog = system.store.backlog

            def hanging(now: float) -> Backlog:
                assert released.wait(60.0)
                return backlog(now)

            monkeypatch.setattr(system.store, "backlog", hanging)
            try:
                for _ in range(9):  # more than there are threads for the store
                    assert not (await client.get("/healthz")).json()["store"]
                assert "servotwin_store_ok 0" in (await client.get("/metrics")).text.splitlines()
            finally:
                released.set()
            while not (await client.get("/healthz")).json()["store"]:
                await asyncio.sleep(0.02)

    asyncio.run(body())


def test_a_damaged_store_is_told_by_its_damage_alone() -> None:
    watched = Watched()
    watched.damage, watched.leases = "page 7 is damaged", "damaged"
    watched.looked(30)
    watched.writes.failure, watched.writes.failed_at = "it is damaged and not written", watched.now
    watched.looked(1)
    watched.damage, watched.leases = "", ""
    watched.looked(30)
    assert not watched.told


def test_the_twin_logs_and_posts_that_its_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(store_health, "_LOOK_S", 0.02)
    monkeypatch.setattr(store_health, "_LASTS_S", 0.1)
    monkeypatch.setattr(store_health, "_OVER_S", 0.1)
    caplog.set_level(logging.INFO)
    posted: list[tuple[str, str, str]] = []

    def full(*_: object) -> None:
        raise StoreUnavailable(FULL)

    async def body() -> None:
        path = twin_file(tmp_path, '[service.webhook]\nurl = "http://127.0.0.1:9/hook"')
        async with served(path) as (system, client), asyncio.timeout(60.0):
            assert system.webhook is not None
            monkeypatch.setattr(
                system.webhook, "_send", lambda _config, post: posted.append((post.servo, post.kind, post.sentence))
            )
            write = system.store.write

            async def send(boot: str) -> int:
                answer = await client.post(
                    "/v1/servos/ax-1/letters", content=hello(boot=boot), headers={**MSGPACK, **bearer()}
                )
                return answer.status_code

            monkeypatch.setattr(system.store, "write", full)
            assert await send("b1") == 503
            while not posted:
                await asyncio.sleep(0.02)
            health = await client.get("/healthz")
            assert health.status_code == 503
            assert not health.json()["store"]
            monkeypatch.setattr(system.store, "write", write)
            assert await send("b1") == 202
            while "store available again" not in caplog.messages:
                await asyncio.sleep(0.02)
            assert (await client.get("/healthz")).json()["store"]

    asyncio.run(body())
    assert posted == [("twin", KIND, FULL + MEANWHILE)]
    assert caplog.messages.count(KIND) == 1


def test_a_full_disk_gets_one_line_on_the_note_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            await client.post("/v1/servos/ax-1/letters", content=hello(), headers={**MSGPACK, **bearer()})
            with monkeypatch.context() as patched:
                patched.setattr(store_watch, "replace_file", full)
                for _ in range(5):
                    system.watch.mark()
            assert caplog.messages.count("newest message not noted") == 1
            system.watch.mark()

    asyncio.run(body())
    assert (tmp_path / "twin.db-newest").read_text() == "1\n"


def test_reasons_that_take_turns_are_logged_once_each(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    watched = Watched()
    for _ in range(20):  # as on a full disk of PostgreSQL, where now one file cannot grow and now another
        for reason in ("no room for messages", "no room for bodies"):
            watched.leases = reason
            watched.looked(1)
    assert lines(caplog) == [(KIND, "no room for messages"), (KIND, "no room for bodies")]
    assert len(watched.told) == 1


def test_a_store_that_turned_read_only_is_not_healthy_although_nobody_writes(tmp_path: Path) -> None:
    """It looked healthy until the first window."""

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            assert (await client.get("/healthz")).json()["store"] is True
            forbid(system.store, "ON")
            await system._store_health.try_write(system.store.write_nothing)
            assert (await client.get("/healthz")).json()["store"] is False
            assert "attempt to write a readonly database" in system._store_health.trouble
            forbid(system.store, "OFF")
            await system._store_health.try_write(system.store.write_nothing)
            assert (await client.get("/healthz")).json()["store"] is True

    asyncio.run(body())


def forbid(store: Store, state: str) -> None:
    """Let SQLite's one writing connection refuse to write, or write again."""
    with closing(store.engines.writer.raw_connection()) as connection:
        connection.cursor().execute(f"PRAGMA query_only = {state}")
