"""Commands that read a damaged store say so in one sentence."""

import os
import re
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from service_system import twin_file
from store_cases import outcome, window
from typer.testing import CliRunner

from servotwin.cli.app import INVALID, app
from servotwin.store import engine
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import EvidenceRecord
from servotwin.store.store import open_store
from servotwin.store.stored_value import WrongRow

COMMANDS = ["twin check", "servos", "audit ax-1", "replay ax-1", "backup b.db"]


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


def overwrite(file: Path, table: str) -> None:
    """Overwrite the root page of a table with noise."""
    with closing(sqlite3.connect(file)) as reader:
        [(page,)] = reader.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,))
        [(size,)] = reader.execute("PRAGMA page_size")
    with file.open("r+b") as opened:
        opened.seek((page - 1) * size)
        opened.write(os.urandom(size))


@pytest.mark.parametrize("command", [["servos"], ["servos", "--json"], ["audit", "ax-1"]])
def test_what_a_damaged_store_still_gives_is_shown_with_the_damage(tmp_path: Path, command: list[str]) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    store = open_store(str(file))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    overwrite(file, "bodies")
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert "ax-1" in result.stdout
    assert result.stderr.startswith(f"error: store sqlite:///{file}: is damaged (")
    assert "restore a backup" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("command", [["servos"], ["audit", "ax-1"], ["audit", "ax-2"]])
def test_a_store_that_has_lost_messages_is_not_shown_as_whole(tmp_path: Path, command: list[str]) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    store = open_store(str(file))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    (tmp_path / "twin.db-newest").write_text("9\n")
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert "has lost messages (its newest message is number 4, and it once had number 9)" in result.stderr


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


@pytest.mark.parametrize("beside", [[], ["twin.db-wal", "twin.db-shm"]], ids=["alone", "with an empty log"])
def test_a_store_that_was_cut_to_nothing_is_not_checked_as_a_new_one(tmp_path: Path, beside: list[str]) -> None:
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    for name in [file.name, *beside]:
        (tmp_path / name).touch()
    result = CliRunner().invoke(app, ["twin", "check", "--config", str(config)])
    assert result.exit_code == INVALID
    assert "twin.db: is empty: cut short, or never written; restore a backup, or let the twin begin" in result.stderr
    assert file.stat().st_size == 0


@pytest.mark.slow
@pytest.mark.parametrize("command", [["twin", "check"], ["servos"], ["twin"], ["backup", "b.db"], ["restore", "b.db"]])
def test_a_folder_in_the_place_of_the_store_is_called_one(tmp_path: Path, command: list[str]) -> None:
    config = twin_file(tmp_path)
    (tmp_path / "twin.db").mkdir()
    before = sorted(tmp_path.iterdir())
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert result.stderr == f"error: store {tmp_path / 'twin.db'}: is a folder; give the name of a file\n"
    assert sorted(tmp_path.iterdir()) == before


def test_a_backup_that_is_a_device_is_called_one(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["restore", "/dev/zero", "--config", str(twin_file(tmp_path))])
    assert result.exit_code == INVALID
    assert result.stderr == "error: backup /dev/zero: is a device; give the name of a file\n"


def test_a_store_that_begins_on_an_empty_file_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    file = tmp_path / "twin.db"
    file.touch()
    for _ in range(2):
        open_store(str(file)).close()
    assert caplog.messages.count("new store") == 1


def changed_store(folder: Path, *changes: str) -> Path:
    """File of a twin whose store holds four windows, after some changes to its rows."""
    config, file = twin_file(folder), folder / "twin.db"
    store = open_store(str(file))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    with closing(sqlite3.connect(file)) as writer:
        for change in changes:
            writer.execute(f"UPDATE {change}")
        writer.commit()
    return config


@pytest.mark.parametrize("command", [["servos"], ["audit", "ax-1"], ["replay", "ax-1"], ["backup", "b.db"]])
def test_a_text_that_is_none_is_said_as_damage_without_its_bytes(tmp_path: Path, command: list[str]) -> None:
    config = changed_store(
        tmp_path,
        "messages SET servo = CAST(x'61782d31ff' AS TEXT), encoding = CAST(x'ff' AS TEXT)",
        "twins SET servo = CAST(x'61782d31ff' AS TEXT)",
    )
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert re.match(r"error: store .*: is damaged \(a text in column '\w+' is not UTF-8\)", result.stderr)
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("twins SET gap = 'abc'", "column twins.gap holds a text where a number belongs"),
        ("messages SET encoding = x'ff'", "column messages.encoding holds bytes where a text belongs"),
        ("messages SET sequence = 1.5", "column messages.sequence holds a number where a whole number belongs"),
        ("bodies SET body = 'abc'", "column bodies.body holds a text where bytes belong"),
        (
            "servotwin_version SET version_num = x'ff'",
            "column servotwin_version.version_num holds bytes where the four digits of a schema belong",
        ),
        (
            "servotwin_version SET version_num = 'abc'",
            "column servotwin_version.version_num holds 'abc' where the four digits of a schema belong",
        ),
    ],
)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_value_of_another_type_is_said_as_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, change: str, why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    config = changed_store(tmp_path, change)
    result = CliRunner().invoke(app, [*command.split(), "--config", str(config)])
    assert result.exit_code == INVALID
    assert re.fullmatch(rf"error: store .*: is damaged \((.*is damaged \()?{why}(, in .*)?\)+.*\n", result.stderr)


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("twins.last_message", "9e300", "9e+300 where a time, in s since the epoch, before the year 10000"),
        ("messages.received", "-1", "-1.0 where a time, in s since the epoch, before the year 10000"),
        ("twins.serial", "9223372036854775807", "9223372036854775807 where a count up to 2**53"),
        ("messages.sequence", "-1", "-1 where a count up to 2**53"),
        ("messages.kind", "'{'", "'{' where one of window, letter, act, verification"),
    ],
)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_value_that_cannot_be_is_said_as_damage_with_its_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, column: str, value: str, why: str
) -> None:
    """A time far ahead ended `servos` and `audit` with a traceback."""
    monkeypatch.chdir(tmp_path)
    table, name = column.split(".")
    config = changed_store(tmp_path, f"{table} SET {name} = {value} WHERE rowid = 1")
    result = CliRunner().invoke(app, [*command.split(), "--config", str(config)])
    row = "servo 'ax-1'" if table == "twins" else "id 1"
    assert result.exit_code == INVALID
    assert f"is damaged (column {column} holds {why} belongs, in the row of {row}); " in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("states SET state = x'83'", "column states.state holds what is no MessagePack, in the row of servo 'ax-1'"),
        (
            "outgoing SET body = x'c1'",
            "column outgoing.body holds what is no MessagePack, in the row of servo 'ax-1', serial 1",
        ),
        ("evidence SET body = x''", "column evidence.body holds what is no MessagePack, in the row of id 1"),
        ("contexts SET text = '{'", "column contexts.text holds what is no JSON, in the row of key 'c'"),
    ],
)
def test_a_content_that_is_cut_short_is_said_by_the_check(tmp_path: Path, change: str, why: str) -> None:
    """Nothing told that, and a state that cannot be read costs its servo what the twin had learnt."""
    config, file = twin_file(tmp_path), tmp_path / "twin.db"
    with closing(open_store(str(file))) as store:
        store.put([window("ax-1", 0)])
        (lease,) = store.lease("me", 1, 30.0, 200.0)
        record = EvidenceRecord("estimate", lease.messages[0].id, b"\x80", context="c")
        made = outcome(lease, record, state=b"\x80", outgoing=(b"\x80",), contexts=(("c", "{}"),))
        store.commit([made], 201.0)
        store.fleet("a name")
    arguments = ["twin", "check", "--config", str(config)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    with closing(sqlite3.connect(file)) as writer:
        writer.execute(f"UPDATE {change}" + (" WHERE key = 'c'" if change.startswith("contexts") else ""))
        writer.commit()
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == INVALID
    assert f"is damaged ({why}); " in result.stderr
    assert result.stderr.count("\n") == 1


def test_output_that_is_no_terminal_has_no_empty_line_for_the_progress(tmp_path: Path) -> None:
    config = twin_file(tmp_path)
    store = open_store(str(tmp_path / "twin.db"))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    (tmp_path / "other").mkdir()
    copy, other = str(tmp_path / "b.db"), twin_file(tmp_path / "other")
    for command, file in ((["twin", "check"], config), (["backup", copy], config), (["restore", copy], other)):
        result = CliRunner().invoke(app, [*command, "--config", str(file)])
        assert (result.exit_code, result.stdout.count("\n")) == (0, 1), result.stdout


def test_a_backup_of_a_store_that_has_lost_messages_says_so_and_replaces_none(tmp_path: Path) -> None:
    config, copy = twin_file(tmp_path), tmp_path / "b.db"
    store = open_store(str(tmp_path / "twin.db"))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    (tmp_path / "twin.db-newest").write_text("9\n")
    lost = "has lost messages (its newest message is number 4, and it once had number 9)"
    command = ["backup", str(copy), "--replace", "--config", str(config)]
    result = CliRunner().invoke(app, command)
    assert (result.exit_code, "4 messages" in result.stdout) == (INVALID, True)
    assert result.stderr == f"error: backup {copy}: is written, but its store {lost}; keep the earlier ones\n"
    written = copy.stat()
    result = CliRunner().invoke(app, command)
    assert (result.exit_code, result.stdout) == (INVALID, "")
    assert result.stderr == f"error: backup {copy}: is not replaced, because the store {lost}; give another file\n"
    assert (copy.stat().st_ino, copy.stat().st_mtime_ns) == (written.st_ino, written.st_mtime_ns)


@pytest.mark.parametrize("command", [["servos"], ["audit", "ax-2"]])
def test_a_servo_that_is_set_aside_is_left_out_and_it_is_said(tmp_path: Path, command: list[str]) -> None:
    config = twin_file(tmp_path)
    with closing(open_store(str(tmp_path / "twin.db"))) as store:
        store.put([window("ax-1"), window("ax-2")])
        store.set_aside([WrongRow("ax-1", "message 1: its body differs", 1)])
    result = CliRunner().invoke(app, [*command, "--config", str(config)])
    assert result.exit_code == INVALID
    assert "ax-2" in result.stdout
    assert "ax-1" not in result.stdout
    assert "left out (ax-1: message 1: its body differs): put their rows right or delete them" in result.stderr
    assert result.stderr.count("\n") == 1
