"""A copied folder with two whole edges, control process and link process each, against a real twin over HTTP."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from service_system import TOKEN, twin_file
from services import service
from stubmachine import StubMachine
from waiting import PATIENCE, until

from servotwin.control.controller import Controller
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge_process.config import UNBOOTED, EdgeConfig, TwinLink
from servotwin.edge_process.config_file import edge_toml
from servotwin.edge_process.monitoring import read_status
from servotwin.messages import Setting
from servotwin.runtime.retry import Retry

RATE = 500.0
LAW = Controller(200.0, 0.0, 0.0, 0.1, voltage_limit=10.0, sample_rate=RATE)


@contextmanager
def edge(folder: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "servotwin.edge_process", str(folder / "edge.toml")]
    with (folder / "log").open("ab") as log:
        process = subprocess.Popen(command, stderr=log, start_new_session=True)
    try:
        yield
        process.terminate()
        assert process.wait(PATIENCE) == 0
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def conflict(folder: Path) -> bool:
    return (read_status(folder / "status.json") or {}).get("conflict") is True


@pytest.mark.slow
def test_of_two_whole_edges_of_one_identity_the_newer_one_lives_and_both_sides_say_so(tmp_path: Path) -> None:
    first, copy = tmp_path / "first", tmp_path / "copy"
    first.mkdir()

    def asked(text: str) -> list[tuple]:
        with closing(sqlite3.connect(f"file:{tmp_path / 'twin.db'}?mode=ro", uri=True)) as database:
            return database.execute(text).fetchall()

    def boot(folder: Path) -> str:
        return str((read_status(folder / "status.json") or {}).get("boot"))

    def stored(name: str) -> int:
        return int(asked(f"SELECT count(*) FROM messages WHERE kind = 'window' AND boot = '{name}'")[0][0])

    with ExitStack() as stack:
        url = stack.enter_context(service(twin_file(tmp_path, 'store = "sqlite:///twin.db"')))
        machines = [stack.enter_context(StubMachine(RATE)) for _ in range(2)]
        fallback = Supervision(FallbackSet(Setting(0.0)), watch=None)
        agent = AgentSettings(
            "ax-1", UNBOOTED, RATE, 0.2, retry=Retry(0.1, 2.0, 0.5), limits=Limits(maximum=1e-3), supervision=fallback
        )
        drives = [{"kind": "simulated", "address": machine.address} for machine in machines]
        link = TwinLink(url, "token", timeout_s=5.0, wait_s=1.0)
        config = EdgeConfig(agent, "control", LAW, drives[0], link, folder=first)
        (first / "edge.toml").write_text(edge_toml(config))
        (first / "token").touch(0o600)
        (first / "token").write_text(TOKEN)
        with edge(first):
            until(lambda: (first / "status.json").exists() and stored(boot(first)) > 1)
            one = boot(first)
            shutil.copytree(first, copy, ignore=shutil.ignore_patterns("*.new", "*-lock"))
            (copy / "edge.toml").write_text(edge_toml(replace(config, drive=drives[1], folder=copy)))
            (copy / "status.json").unlink(missing_ok=True)
            with edge(copy):
                until(lambda: conflict(first))
                ended = stored(one)
                until(lambda: stored(boot(copy)) > 2)
                until(lambda: (read_status(first / "status.json") or {}).get("fallback") is True)
                assert not conflict(copy)
                assert stored(one) == ended, "the older edge went on sending"
                until(lambda: bool(asked("SELECT 1 FROM evidence WHERE kind = 'alarm' AND status LIKE 'conflict: %'")))
                assert (read_status(first / "status.json") or {})["windows"]["waiting"] > 0
    assert '"event":"conflict"' in (first / "log").read_text()
    assert '"event":"conflict"' not in (copy / "log").read_text()
    assert '"message":"conflict"' in (tmp_path / "twin.log").read_text()
