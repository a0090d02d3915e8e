"""A twin that starts on a clock that is behind its store says so, and loses nothing."""

import asyncio
import logging
import time
from pathlib import Path

import pytest
from postgres import Server
from service_system import bearer, place, served, twin_file, window
from store_cases import postgresql_addresses

from servotwin.messages import encode
from servotwin.twin_service import ingest, service

pytest_plugins = ("store_fixtures",)

DAY = 86400.0


def started(
    folder: Path, monkeypatch: pytest.MonkeyPatch, days: float, sequence: int, service_keys: str = ""
) -> tuple[int, list[str], list[tuple[str, str]]]:
    """Start a twin whose clock is off by some days, and send a window; status, what is degraded, and alarms."""
    told: list[tuple[str, str]] = []
    monkeypatch.setattr(
        ingest.Clocks, "of_machine", lambda: ingest.Clocks(lambda: time.time() + days * DAY, time.monotonic)
    )
    monkeypatch.setattr(service.TwinService, "_announce", lambda _, *alarm: told.append(alarm[:2]))

    async def body() -> tuple[int, list[str]]:
        async with served(twin_file(folder, service_keys)) as (_, client):
            await asyncio.sleep(0.2)
            sent = window(sequence)
            answer = await client.put(place(sent), content=encode(sent), headers=bearer())
            degraded = (await client.get("/healthz")).json()["degraded"]
            # There is no worker: by a clock that is ahead, the windows of before wait for long.
            return answer.status_code, [sentence for sentence in degraded if "have waited" not in sentence]

    return *asyncio.run(body()), told


@pytest.mark.slow
def test_a_twin_whose_clock_is_behind_its_store_says_so_with_both_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    assert started(tmp_path, monkeypatch, 0.0, 0) == (201, [], [])
    status, degraded, told = started(tmp_path, monkeypatch, -60.0, 1)
    assert status == 201, "edges go on"
    [sentence] = degraded
    then, now = (time.strftime("%Y-%m-%d", time.gmtime(time.time() + days * DAY)) for days in (-60.0, 0.0))
    assert f"the clock said {then} " in sentence
    assert f"newest message came on {now} " in sentence
    assert told == [("clock behind the store", sentence)]
    assert caplog.messages.count("clock behind the store") == 1
    # Ahead cannot be told from silence; back again, it was the other one that was wrong: until a restart.
    assert started(tmp_path, monkeypatch, 60.0, 2) == (201, [], [])
    assert len(started(tmp_path, monkeypatch, 0.0, 3)[1]) == 1
    assert started(tmp_path, monkeypatch, 0.0, 3) == (200, [], [])


@pytest.mark.slow
@pytest.mark.parametrize("days", [0.0, 0.5 / DAY, 4.0 / DAY, -4.0 / DAY, 1 / 24, -1 / 24, 60.0])
def test_a_twin_whose_clock_differs_from_postgresqls_says_so_whichever_is_ahead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, postgres_server: Server, days: float
) -> None:
    address = postgresql_addresses(postgres_server)()
    status, degraded, told = started(tmp_path, monkeypatch, days, 0, f'store = "{address}"')
    assert status == 201, "edges go on"
    if abs(days) < 1.0 / DAY:
        assert (degraded, told) == ([], [])
        return
    [sentence] = degraded
    assert told == [("clock differs from the database server's", sentence)]
    then = time.strftime("%Y-%m-%d %H:", time.gmtime(time.time() + days * DAY))
    assert f"the clock said {then}" in sentence
    assert "that of the database's server " in sentence
