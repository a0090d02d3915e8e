"""A twin is told to end while a worker hangs."""

import json
import os
import signal
import sqlite3
import time
from pathlib import Path

import httpx
import pytest
from service_system import bearer, place, process, twin_file, window
from waiting import until

from servotwin.messages import encode

TURN = "SELECT servo FROM twins WHERE lease_owner IS NOT NULL"


@pytest.mark.slow
def test_a_twin_ends_although_a_worker_hangs_and_the_next_one_has_its_work_at_once(tmp_path: Path) -> None:
    path = twin_file(tmp_path)
    with process(path) as (running, url), sqlite3.connect(tmp_path / "twin.db") as store:
        [worker] = map(int, Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split())
        os.kill(worker, signal.SIGSTOP)
        sent = window()
        answer = httpx.put(f"{url}{place(sent)}", content=encode(sent), headers=bearer())
        assert answer.status_code == 201
        until(lambda: store.execute(TURN).fetchall())
        begun = time.monotonic()
        running.send_signal(signal.SIGTERM)
        assert running.wait(60) == 0
        assert time.monotonic() - begun < 45.0
        assert not Path(f"/proc/{worker}").exists()
        assert not store.execute(TURN).fetchall()
        assert store.execute("SELECT done FROM messages").fetchall() == [(None,)]
    lines = [json.loads(line)["message"] for line in (tmp_path / "log").read_text().splitlines()]
    assert "work not finished at the end: it is repeated" in lines
    with process(path), sqlite3.connect(tmp_path / "twin.db") as store:
        until(lambda: store.execute("SELECT done FROM messages").fetchall() != [(None,)])
