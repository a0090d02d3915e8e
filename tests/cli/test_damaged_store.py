"""Commands that read a damaged store say so in one sentence."""

import os
import sqlite3
from pathlib import Path

import pytest
from service_system import twin_file
from store_cases import window
from typer.testing import CliRunner

from servotwin.cli.app import INVALID, app
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
