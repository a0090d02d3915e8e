"""Commands that read a damaged store say so in one sentence."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from service_system import twin_file
from store_cases import window
from typer.testing import CliRunner

from servotwin.cli.app import INVALID, app
from servotwin.store import engine
from servotwin.store.engine import StoreUnavailable
from servotwin.store.store import open_store


@pytest.mark.parametrize("command", [["audit", "ax-1"], ["audit", "ax-1", "--json"], ["replay", "ax-1"]])
def test_a_damaged_store_is_one_sentence(tmp_path: Path, command: list[str]) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    store = open_store(str(file))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    with sqlite3.connect(file) as reader:
        [(page,)] = reader.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
        [(size,)] = reader.execute("PRAGMA page_size")
    reader.close()
    with file.open("r+b") as opened:
        opened.seek((page - 1) * size)
        opened.write(os.urandom(size))
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert result.stderr.startswith("error: store sqlite:")
    assert result.stderr.count("\n") == 1
    assert "is damaged" in result.stderr


def test_a_store_is_checked_and_read_while_another_program_writes_to_it(tmp_path: Path) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    store = open_store(str(file))
    store.put([window("ax-1", n) for n in range(4)])
    with store.writing():
        result = CliRunner().invoke(app, ["twin", "check", "--config", str(config)])
    store.close()
    assert (result.exit_code, result.stderr) == (0, "")
    assert "is sound (4 messages agree with their digests)" in result.stdout


def test_a_store_that_another_program_keeps_locked_is_said_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "_BUSY_S", 0.1)
    said = pytest.raises(StoreUnavailable, match=r"another program has kept it locked for 0\.1 s")
    address = str(tmp_path / "twin.db")
    with closing(open_store(address)) as one, closing(open_store(address)) as other, one.writing(), said:
        other.put([window("ax-1", 1)])


def test_a_store_that_was_cut_to_nothing_is_not_checked_as_a_new_one(tmp_path: Path) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    file.touch()
    result = CliRunner().invoke(app, ["twin", "check", "--config", str(config)])
    assert result.exit_code == INVALID
    assert "twin.db: is empty: cut short, or never written" in result.stderr
    assert file.stat().st_size == 0
