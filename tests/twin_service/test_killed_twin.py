"""A twin on PostgreSQL is killed at work, or its database restored from a dump of that moment: work goes on at once."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import httpx
import pytest
from postgres import Server
from servers import needed
from service_system import OPERATOR, OTHER, TOKEN, bearer, place, process, twin_file, window
from waiting import until

from servotwin.messages import encode

pytest_plugins = ("store_fixtures",)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="signals")]

SOON_S = 20.0
"""The lease of a process that is gone ends meanwhile, on a busy machine too; nobody waits two minutes for it."""
SERVOS = {"ax-1": TOKEN, "ax-2": OTHER}


def leased(server: Server, database: str) -> set[str]:
    with server.connect(database) as connection:
        return {servo for (servo,) in connection.execute("SELECT servo FROM twins WHERE lease_owner IS NOT NULL")}


def stop_at_work(server: Server, database: str, pid: int, url: str) -> None:
    """Send a window of each servo to a twin whose only worker does not answer any more."""
    [worker] = map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    os.kill(worker, signal.SIGSTOP)
    with httpx.Client(base_url=url) as client:
        for servo, token in SERVOS.items():
            sent = window(servo=servo)
            assert client.put(place(sent), content=encode(sent), headers=bearer(token)).status_code == 201
    until(lambda: leased(server, database))


def seconds_until_all_is_done(url: str) -> float:
    begun = time.monotonic()
    with httpx.Client(base_url=url) as client:

        def waiting() -> int:
            servos = client.get("/v1/servos", headers=bearer(OPERATOR)).json()
            return sum(each["waiting"] for each in servos if each["servo"] in SERVOS)

        until(lambda: not waiting(), 200.0)
    return time.monotonic() - begun


def test_the_twin_after_a_killed_one_soon_works_on_the_servos_that_had_their_turn(tmp_path, postgres_server):
    path = twin_file(tmp_path, f'store = "{postgres_server.database("killed")}"')
    with process(path) as (running, url):
        stop_at_work(postgres_server, "killed", running.pid, url)
    with process(path) as (_, url):
        assert seconds_until_all_is_done(url) < SOON_S


def test_a_young_dump_is_worked_on_soon_although_the_owner_of_its_leases_lives(tmp_path, postgres_server):
    program = needed("initdb").resolve().with_name("pg_dump")
    path = twin_file(tmp_path, f'store = "{postgres_server.database("site")}"')
    with process(path) as (running, url):
        stop_at_work(postgres_server, "site", running.pid, url)
        address = postgres_server.database("restored")
        place = ("-h", postgres_server.folder, "-U", postgres_server.user)
        dumped = subprocess.run([program, *place, "site"], check=True, capture_output=True)
        command = [program.with_name("psql"), "-q", "-v", "ON_ERROR_STOP=1", *place, "restored"]
        subprocess.run(command, input=dumped.stdout, check=True, capture_output=True)
        assert leased(postgres_server, "restored")
        other = tmp_path / "other"
        other.mkdir()
        shutil.copy(tmp_path / "tokens.toml", other)
        with process(twin_file(other, f'store = "{address}"\ntokens = "tokens.toml"', tokens=False)) as (_, there):
            assert seconds_until_all_is_done(there) < SOON_S
