"""Lines of the twin's log that the alarms page explains come when what they say happens."""

import asyncio
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from service_system import bearer, place, served, twin_file, window

from servotwin.messages import encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import open_store
from servotwin.twin_service import command, service
from servotwin.twin_service.auth import read_tokens, write_tokens
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool

DAY = 86400.0
Log = pytest.LogCaptureFixture


async def until(condition) -> None:
    async with asyncio.timeout(60.0):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.mark.slow
def test_a_clock_that_was_75_days_ahead_is_said_and_deletes_nothing_new(
    tmp_path: Path, caplog: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A day has a window; the twin is started on a wrong clock after 40 days, and on the right one 5 days later."""
    caplog.set_level("INFO")
    monkeypatch.setattr(service, "_RETENTION_S", 0.0)
    twin, today, error = read_twin(twin_file(tmp_path)), 0.0, 0.0
    store = open_store(twin.service.store)
    clocks = Clocks(wall=lambda: (today + error) * DAY, monotonic=lambda: today * DAY)
    system = TwinService(twin, store, clocks, WorkerPool(0, twin.start, 1.0))

    async def live(days: int) -> int:
        """Store a window a day, mark all as done, and let retention run; the number of windows with their bodies."""
        nonlocal today
        for _ in range(days):
            today += 1.0
            item, _ = system.ingest.read("ax-1", encode(window(int(today), start=0.0)), "")
            store.put([item])
        with store.engines.writer.begin() as connection:
            connection.exec_driver_sql("UPDATE messages SET done = received")
        running = asyncio.create_task(system._apply_retention())
        await asyncio.sleep(0.2)
        running.cancel()
        with store.engines.reader.begin() as connection:
            return int(connection.exec_driver_sql("SELECT count(*) FROM bodies").scalar_one())

    try:
        counts = [asyncio.run(live(20))]
        assert "retention leaves out a gap" not in caplog.messages
        counts.append(asyncio.run(live(20)))
        error = 75.0
        counts.append(asyncio.run(live(5)))
        assert "retention leaves out a gap" in caplog.messages
        error = 0.0
        counts += [asyncio.run(live(5)), asyncio.run(live(60))]
    finally:
        system.commits.close()
        system.executor.close()
        store.close()
    assert counts[0] == 20
    assert all(27 <= count <= 31 for count in counts[1:]), counts
    assert "old window bodies deleted" in caplog.messages


def test_tasks_that_end_leases_and_marks_that_cannot_be_written_are_said(
    tmp_path: Path, caplog: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken() -> None:
        raise ValueError("a defect")

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            sent = window()
            await client.put(place(sent), content=encode(sent), headers=bearer())
            (tmp_path / "twin.db-newest.new").mkdir()
            system.watch.mark()
            system._spawn(broken())
            await until(lambda: not system.dispatching)
            assert (await client.get("/healthz")).json()["dispatching"] is False

            def full(*_: object) -> None:
                raise StoreUnavailable("the disk is full")

            monkeypatch.setattr(system.store, "release", full)

    asyncio.run(body())
    expected = {"newest message not noted", "a task of the service ended", "leases not released"}
    assert expected <= set(caplog.messages)


def test_tokens_that_are_replaced_and_a_twin_without_any_are_said(
    tmp_path: Path, caplog: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO")

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, _):
            known = read_tokens(tmp_path / "tokens.toml")
            write_tokens(tmp_path / "tokens.toml", replace(known, servos={}))
            system.tokens.refresh()

    asyncio.run(body())
    assert "tokens reloaded" in caplog.messages
    twin = read_twin(twin_file(tmp_path, tokens=False))
    monkeypatch.setattr(command, "TwinService", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        command.serve(twin, None, None, None)  # type: ignore[arg-type]
    assert "no tokens: whoever reaches this machine itself may do everything" in caplog.messages


def test_a_worker_that_does_not_start_is_said_and_tried_again(tmp_path: Path, caplog: Log) -> None:
    twin = read_twin(twin_file(tmp_path))

    async def body() -> None:
        pool = WorkerPool(1, twin.start, 5.0, ("false",))
        trying = asyncio.create_task(pool.replace(pool._make(), "the worker ended"))
        await until(lambda: caplog.messages.count("worker does not start") > 1)
        trying.cancel()
        await asyncio.gather(trying, return_exceptions=True)
        await pool.stop()

    asyncio.run(body())
    assert "worker replaced" in caplog.messages


def test_a_twin_whose_log_nobody_reads_serves_and_ends(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b"x" * 4096)
    os.set_blocking(writer, True)
    command = [sys.executable, "-m", "servotwin", "twin", "--config", str(twin_file(tmp_path))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writer, text=True) as twin:
        assert twin.stdout is not None
        try:
            assert select.select([twin.stdout], [], [], 60.0)[0], "it waits for the reader of its log"
            url = twin.stdout.readline().split()[-1]
            refused = httpx.get(f"{url}/v1/servos", timeout=10.0)
            assert (refused.status_code, httpx.get(f"{url}/healthz", timeout=10.0).status_code) == (401, 200)
            os.set_blocking(reader, False)
            with contextlib.suppress(BlockingIOError):
                while os.read(reader, 4096):
                    pass
            httpx.get(f"{url}/v1/servos", timeout=10.0)
            assert json.loads(os.read(reader, 4096).splitlines()[-1])["lines_lost"] >= 2  # "new store", and a refusal
            twin.send_signal(signal.SIGTERM)
            assert twin.wait(30) == 0
        finally:
            twin.kill()
            os.close(reader)
            os.close(writer)
