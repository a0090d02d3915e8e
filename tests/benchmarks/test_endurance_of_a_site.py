"""`servotwin bench endurance`: what it counts as lost, and its options."""

import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rich.console import Console
from typer.testing import CliRunner

from benchmarks import faults
from benchmarks.cli import app

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
    stored = [("ax-0", "b1", 0, "window"), ("ax-0", "b1", 2, "window"), ("ax-0", "b2", 0, "window")]
    tables = "CREATE TABLE messages (servo, boot, sequence, kind); CREATE TABLE evidence (kind, status);"
    database(tmp_path / "twin.db", tables, messages=stored, evidence=[("receipt", "applied"), ("receipt", "expired")])
    database(
        tmp_path / "ax-0/outbox.sqlite",
        TABLES,
        acknowledged=[("b1", 0), ("b1", 2), ("b2", 0), ("b2", 1)],
        windows=[("b2", 0), ("b2", 1), ("b2", 2)],
        counts=[("dropped: outbox broken", 2), ("sent", 9)],
    )
    site: Any = SimpleNamespace(
        folder=tmp_path, edges={"ax-0": None}, outbox=lambda servo: tmp_path / servo / "outbox.sqlite"
    )
    site.stored, site.waiting = lambda: faults.Site.stored(site), lambda: faults.Site.waiting(site)
    samples = [(float(second), {"twin": 100 + second}) for second in range(10)]
    found = faults._figures(site, {"edge killed": 3}, samples)
    assert (found.stored, found.boots, found.applied) == (3, 2, 1)
    assert (found.lost_acknowledged, found.holes, found.counted, found.waiting) == (1, 1, 2, 1)
    assert found.memory == {"twin": (103, 109)}
    with (console := Console(width=120)).capture() as printed:
        console.print(faults.shown(found))
    lines = [line.split() for line in printed.get().splitlines()]
    assert ["acknowledged,", "and", "not", "stored", "1"] in lines
    assert ["faults:", "edge", "killed", "3"] in lines


def test_minutes_are_for_the_endurance_alone() -> None:
    done = CliRunner().invoke(app, ["fleet", "--minutes", "1"])
    assert done.exit_code != 0
    assert "only bench endurance takes it" in str(done.exception)
