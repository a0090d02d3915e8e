"""A twin's store in the place of an edge's outbox, an outbox in that of a store: one sentence, the file as it was."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from edge_files import edge_file
from outbox_cases import window

from servotwin.edge_process.config_file import load
from servotwin.edge_process.startup import check
from servotwin.errors import InvalidInput
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.store.backup import backup, restore
from servotwin.store.store import open_store


def strangers_file(path: Path) -> None:
    with closing(sqlite3.connect(path)) as made:
        made.execute("CREATE TABLE invoices (id)")
        made.commit()


def twins_store(path: Path) -> None:
    open_store(str(path)).close()


def adopted(path: Path) -> None:
    """A twin's store in which an older edge has made its tables."""
    twins_store(path)
    with closing(sqlite3.connect(path)) as opened:
        opened.execute("CREATE TABLE windows (place INTEGER PRIMARY KEY)")
        opened.commit()


@pytest.mark.parametrize(
    ("make", "kind"),
    [(twins_store, "a twin's store"), (adopted, "a twin's store"), (strangers_file, "another program's database")],
)
def test_an_edge_does_not_take_another_kind_of_file_for_its_outbox(tmp_path, make, kind):
    (tmp_path / "edge.toml").write_text(edge_file(tables='[keep]\noutbox = "any.db"\n'))
    file = tmp_path / "any.db"
    make(file)
    before, names = file.read_bytes(), set(tmp_path.iterdir())
    for opening in (lambda: check(load(tmp_path / "edge.toml")), lambda: SqliteOutbox(file, "ax-1")):
        with pytest.raises(InvalidInput, match=rf"any\.db: is {kind}, no outbox of an edge; "):
            opening()
    assert file.read_bytes() == before
    assert set(tmp_path.iterdir()) == names


def test_a_twin_does_not_take_an_outbox_for_its_store_or_its_backup(tmp_path):
    file = tmp_path / "outbox.sqlite"
    box = SqliteOutbox(file, "ax-1")
    box.put(window(0))
    box.close()
    before = file.read_bytes()
    with pytest.raises(InvalidInput, match=r"outbox\.sqlite: is the outbox of an edge, no store of a twin; "):
        open_store(str(file))
    with pytest.raises(InvalidInput):
        backup(str(file), tmp_path / "backup.db")
    with pytest.raises(InvalidInput):
        restore(file, str(tmp_path / "new.db"))
    assert file.read_bytes() == before
    assert {each.name for each in tmp_path.iterdir()} <= {"outbox.sqlite", "outbox.sqlite-wal", "outbox.sqlite-shm"}
    with closing(SqliteOutbox(file, "ax-1")) as again:
        assert again.pending()


def test_an_outbox_that_was_killed_before_its_first_checkpoint_is_its_own(tmp_path):
    file = tmp_path / "any.db"
    box = SqliteOutbox(file, "ax-1")
    box.put(window(0))
    copy = tmp_path / "killed"
    copy.mkdir()
    for name in ("any.db", "any.db-wal"):
        (copy / name).write_bytes((tmp_path / name).read_bytes())
    box.close()
    killed = SqliteOutbox(copy / "any.db", "ax-1")
    assert len(killed.pending()) == 1
    killed.close()
