"""`servotwin bench endurance`: what it counts as lost, and its options."""

import io
import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from benchmarks import endurance, endurance_site
from benchmarks.cli import app
from benchmarks.endurance_site import Member, Site, Witness, ask

TABLES = """
CREATE TABLE acknowledged (boot, sequence);
CREATE TABLE windows (boot, sequence);
CREATE TABLE counts (what, number);
"""


def database(file: Path, tables: str, **rows: list[tuple[Any, ...]]) -> None:
    with closing(sqlite3.connect(file)) as made, made:
        made.executescript(tables)
        for table, values in rows.items():
            made.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(values[0]))})", values)


def test_what_is_acknowledged_and_not_stored_and_what_is_missing_within_a_boot_is_lost(tmp_path: Path) -> None:
    """One window is acknowledged and gone, one is missing in a boot, two were counted, one waits."""
    (tmp_path / "ax-0").mkdir()
    stored = [("ax-0", "b1", 0, "window", 1.0), ("ax-0", "b1", 2, "window", None), ("ax-0", "b2", 0, "window", 1.0)]
    letters = [("ax-0", "", -1, "letter", None), ("ax-0", "", -1, "letter", None)]
    tables = """
    CREATE TABLE messages (servo, boot, sequence, kind, done); CREATE TABLE evidence (servo, kind, status, version);
    """
    # A servo that was killed answers an update once more: it was applied once.
    receipts = [("ax-0", "receipt", status, version) for status, version in (("applied", 1), ("applied", 1))]
    receipts.append(("ax-0", "receipt", "expired", 2))
    database(tmp_path / "twin.db", tables, messages=stored + letters, evidence=receipts)
    database(
        tmp_path / "ax-0/outbox.sqlite",
        TABLES,
        acknowledged=[("b1", 0), ("b1", 2), ("b2", 0), ("b2", 1)],
        windows=[("b2", 0), ("b2", 1), ("b2", 2)],
        counts=[("dropped: outbox broken", 2), ("sent", 9)],
    )
    (tmp_path / "ax-0/status.json").write_text('{"schema": "servotwin-edge-status/1", "boot": "b2", "windows_cut": 7}')
    edge = SimpleNamespace(starts=4, ended_alone=1)
    site: Any = SimpleNamespace(
        folder=tmp_path,
        edges={"ax-0": edge},
        twin=SimpleNamespace(ended_alone=2),
        outbox=lambda servo: tmp_path / servo / "outbox.sqlite",
    )
    site.crowd_size = 996
    site.crowd_status = lambda: Site.crowd_status(site)
    site.acknowledged_by_crowd = lambda: Site.acknowledged_by_crowd(site)
    site.stored, site.waiting = lambda: Site.stored(site), lambda: Site.waiting(site)
    # Of the crowd one acknowledged window is stored, and one is not; a line was cut by a kill.
    (tmp_path / "crowd-acknowledged").write_text("ax-0 b1 0\nax-c00001 c-1 7\nax-c00002 c-")
    (tmp_path / "crowd-status.json").write_text('{"waiting": 3, "applied": 5, "refused": {"400": 2}}')
    witness = Witness(site)
    witness.look()
    samples = [(float(second), {"twin": 100 + second}) for second in range(10)]
    found = endurance._figures(site, witness, {"edge killed": 3}, samples)
    assert (found.stored, found.boots, found.applied) == (3, 2, 1)
    assert found.unprocessed == {"window": 1, "letter": 2}
    assert (found.lost_acknowledged, found.holes, found.counted, found.waiting) == (2, 1, 2, 4)
    assert (found.servos, found.refused) == (997, {"400": 2})
    # Seven were cut in b2 up to its last status: one is stored, one waits.
    assert (found.starts, found.ended_alone, found.twin_ended, found.unseen) == (4, 1, 2, 5)
    assert found.memory == {"twin": (103, 109)}
    with (console := Console(width=120)).capture() as printed:
        console.print(endurance.shown(found))
    lines = [line.split() for line in printed.get().splitlines()]
    assert ["acknowledged,", "and", "not", "stored", "2"] in lines
    assert ["growth", "of", "a", "twin,", "bytes", "per", "window;", "MB", "in", "a", "year", "3.0;", "4719"] in lines
    assert ["faults:", "edge", "killed", "3"] in lines
    assert ["stored,", "not", "processed", "at", "the", "end:", "windows;", "letters", "1;", "2"] in lines


@pytest.mark.parametrize(("ended_by", "kept"), [(KeyboardInterrupt, False), (RuntimeError, True)])
def test_an_interrupted_run_leaves_no_files_and_a_failed_one_does(
    ended_by: type[BaseException], kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "endure"

    def ended(*_: object) -> None:
        (folder / "twin.db").touch()
        raise ended_by

    def made(prefix: str) -> str:
        folder.mkdir()
        return str(folder)

    monkeypatch.setattr(endurance, "mkdtemp", made)
    monkeypatch.setattr(endurance, "Site", lambda *_: None)
    monkeypatch.setattr(endurance, "_outcome", ended)
    with pytest.raises(ended_by):
        endurance.endure(minutes=0.1, console=Console(file=(shown := io.StringIO()), width=500))
    assert folder.exists() == kept
    assert (f"the files are kept: {folder}" in shown.getvalue()) == kept


def test_an_outbox_that_cannot_be_read_is_no_empty_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endurance_site, "_PATIENCE_S", 0.0)
    (tmp_path / "outbox.sqlite").write_bytes(b"no database" * 1000)
    for name in ("outbox.sqlite", "missing.sqlite"):
        with pytest.raises(RuntimeError, match=f"{name}: cannot be read"):
            ask(tmp_path / name, "SELECT count(*) FROM windows")


def test_a_process_that_ends_without_a_fault_is_counted_once(tmp_path: Path) -> None:
    # The one that ends does so the first time only: what it is killed in must still run.
    seen, sleep = tmp_path / "seen", "import time; time.sleep(60)"
    ends = f"import os\nif not os.path.exists({str(seen)!r}):\n open({str(seen)!r}, 'w').close(); os._exit(2)\n{sleep}"
    for code, alone in ((ends, 1), (sleep, 0)):
        member = Member(tmp_path, tmp_path / "log", "-c", code)
        member.start()
        if alone:
            assert member.process is not None
            member.process.wait()
            assert member.pid == 0
        member.revive()
        assert member.starts == 1 + alone
        member.kill()
        member.kill()
        member.revive()  # killed by a fault, which starts it itself
        assert (member.starts, member.ended_alone) == (1 + alone, alone)


def test_minutes_are_for_the_endurance_alone() -> None:
    done = CliRunner().invoke(app, ["fleet", "--minutes", "1"])
    assert done.exit_code != 0
    assert "only bench endurance takes it" in str(done.exception)
