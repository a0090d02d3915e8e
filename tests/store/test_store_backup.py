"""Backup, restore and retention: stored data stays whole, and nothing is overwritten."""

import os
import resource
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import sqlalchemy as sa
from store_cases import NEXT, NewAddress, filled, letter, outcome, window

from servotwin.errors import InvalidInput
from servotwin.messages import Resend, decode
from servotwin.store import migrate as migrations
from servotwin.store.backup import RowCounts, backup, restore
from servotwin.store.engine import transaction
from servotwin.store.integrity import message_digest
from servotwin.store.records import EvidenceRecord, PutResult
from servotwin.store.retention import RetentionResult, delete_old_bodies
from servotwin.store.schema import REVISION, bodies
from servotwin.store.store import open_store

pytest_plugins = ("store_fixtures",)
SECRET = "unspeakable"


# Backup and restore


def test_a_backup_restored_holds_the_same(url: str, tmp_path: Path) -> None:
    store = filled(url)
    (claim,) = store.lease("me", 1, 30.0, 200.0)
    store.commit([outcome(claim, EvidenceRecord("estimate", claim.messages[0].id, b"e"), outgoing=(b"u",))], 201.0)
    pages: list[tuple[int, int]] = []
    saved = tmp_path / "backup.db"
    counts, left_out = backup(url, saved, lambda *of: pages.append(of))
    assert not left_out
    assert counts == RowCounts(twins=1, messages=5, bodies=5, evidence=1, outgoing=1)
    assert pages[-1][0] == 0
    assert saved.stat().st_mode & 0o777 == 0o600
    store.put([window(sequence=9)])

    again = f"sqlite:///{tmp_path}/again.db"
    assert restore(saved, again) == (counts, {})
    restored = open_store(again)
    assert restored.audit("a") == store.audit("a")[1:]
    (update, asking) = restored.outgoing("a", 0)
    assert [update] == store.outgoing("a", 0)
    # An edge is asked for the windows that came after the backup.
    assert decode(asking.body) == Resend("a", reason="the twin's store was restored from a backup")
    # What comes no more, the answers to later versions, is said where somebody would look for it.
    (alarm,) = restored.events("a")
    assert (alarm.kind, store.events("a")) == ("alarm", [])
    assert alarm.status.startswith(
        "the twin's store was restored from a backup whose newest message came on 1970-01-01 00:01:44 UTC. Versions"
    )
    assert "the edge's answers to them, are missing" in alarm.status
    assert restored.window("a", "boot", 3) == store.window("a", "boot", 3)
    (summary,) = restored.servos()
    assert summary.posted > store.servos()[0].posted + 100_000
    restored.put([window(sequence=9)])
    (claim,) = restored.lease("me", 1, 30.0, 300.0)
    restored.commit([outcome(claim, outgoing=(b"v", b"w"))], 301.0)
    assert [posted.serial for posted in restored.outgoing("a", asking.serial)] == [
        summary.posted + 1,
        summary.posted + 2,
    ]
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(("backup", ".backup"))) == ["backup.db"]
    restored.close()
    store.close()


def test_a_backup_while_it_is_written_to_is_of_one_moment(url: str, tmp_path: Path) -> None:
    store = filled(url, 50)
    stop = threading.Event()

    def write() -> None:
        sequence = 50
        while not stop.is_set():
            store.put([window(sequence=n, body=os.urandom(3000)) for n in (sequence, sequence + 1)])
            sequence += 2

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for number in range(5):
            counts = backup(url, tmp_path / f"backup-{number}.db").rows
            assert counts.messages == counts.bodies
            assert counts.messages % 2 == 0
    finally:
        stop.set()
        writer.join()
    store.close()


def test_a_store_that_cannot_be_backed_up_is_refused(url: str, tmp_path: Path) -> None:
    to = tmp_path / "backup.db"
    with pytest.raises(InvalidInput, match="there is no such file"):
        backup(url, to)
    with pytest.raises(InvalidInput, match=r"call pg_dump --format=custom --file=.*backup.db DATABASE$") as refused:
        backup(f"postgresql://u:{SECRET}@h/d", to)
    assert SECRET not in str(refused.value)
    other = tmp_path / "other.db"
    sqlite3.connect(other).close()
    with pytest.raises(InvalidInput, match="is not a store of servotwin"):
        backup(str(other), to)
    store = filled(url)
    with pytest.raises(InvalidInput, match="is the store itself"):
        backup(url, tmp_path / "store.db")
    with pytest.raises(InvalidInput, match="cannot be written"):
        backup(url, tmp_path / "nowhere" / "backup.db")
    assert not to.exists()
    store.close()


def test_a_backup_and_a_restore_name_the_file_that_is_damaged_or_cannot_be_written(url: str, tmp_path: Path) -> None:
    filled(url, 400).close()
    to, file, kept = tmp_path / "copy.db", tmp_path / "store.db", tmp_path / "kept.db"
    backup(url, kept)
    for copy in (partial(backup, url, to), partial(restore, kept, str(to))):
        with files_of_at_most(300_000), pytest.raises(InvalidInput, match=rf"^output {to}: cannot be written \("):
            copy()
    damage_pages(file)
    shutil.copyfile(file, kept)
    for copy, damaged in ((partial(backup, url, to), file), (partial(restore, kept, str(to)), kept)):
        with pytest.raises(InvalidInput, match=rf"^store {damaged}: is damaged \("):
            copy()
    assert sorted(path.name for path in tmp_path.iterdir() if "copy" in path.name) == []


def test_a_backup_with_a_body_that_changed_does_not_take_the_place_of_a_sound_one(url: str, tmp_path: Path) -> None:
    store, saved = open_store(url), tmp_path / "backup.db"
    store.put([window(sequence=n, body=b"%d" % n)._replace(digest=message_digest(b"%d" % n)) for n in range(3)])
    counts = backup(url, saved)
    with store.writing() as connection:
        connection.execute(bodies.update().where(bodies.c.message == 2).values(body=b"x"))
    store.close()
    with pytest.raises(InvalidInput, match=r"is damaged \(message 2 of servo 'a': its body differs from its digest\)"):
        backup(url, saved, replace=True)
    assert restore(saved, f"sqlite:///{tmp_path}/again.db") == counts


def test_a_damaged_page_is_told_on_one_line(url: str, tmp_path: Path) -> None:
    store, file = open_store(url), tmp_path / "store.db"
    store.put([window(body=os.urandom(100_000))])
    store.close()
    with file.open("r+b") as opened:
        opened.seek(file.stat().st_size - 4 * 8192)
        opened.write(bytes(8192))  # of the body, which counting rows does not read
    with pytest.raises(InvalidInput) as refused:
        backup(url, tmp_path / "copy.db")
    assert "is damaged (" in str(refused.value)
    assert "\n" not in str(refused.value)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """As on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def damage_pages(file: Path) -> None:
    """Overwrite all pages but those of the schema."""
    size = file.stat().st_size
    with file.open("r+b") as opened:
        opened.seek(size // 8)
        opened.write(os.urandom(size - size // 8))


def test_a_second_restore_of_a_backup_continues_above_the_serials_of_the_first(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, newest = tmp_path / "backup.db", []
    filled(url).close()
    backup(url, saved)
    for now, name in ((1.8e9, "once.db"), (1.8e9 + 60.0, "again.db")):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        restore(saved, str(tmp_path / name))
        store = open_store(str(tmp_path / name))
        newest.append(store.posted(["a"])["a"])
        store.close()
    assert newest[1] == newest[0] + 60_000  # a message in a millisecond is more than an edge is sent


def test_a_backup_replaces_another_one_only_if_told_so(url: str, tmp_path: Path) -> None:
    to = tmp_path / "backup.db"
    filled(url).close()
    counts = backup(url, to)
    before = to.read_bytes()
    with pytest.raises(InvalidInput, match=r"backup.db: exists already; give another file, or --replace"):
        backup(url, to)
    assert to.read_bytes() == before
    assert backup(url, to, replace=True) == counts


def test_a_restore_overwrites_nothing(url: str, tmp_path: Path) -> None:
    store, saved = filled(url), tmp_path / "backup.db"
    backup(url, saved)
    with pytest.raises(InvalidInput, match="is not empty"):
        restore(saved, url)
    empty = tmp_path / "empty.db"
    in_use = open_store(str(empty))
    with pytest.raises(InvalidInput, match="is in use"):
        restore(saved, str(empty))
    in_use.close()
    assert restore(saved, str(empty)).rows.messages == 5
    opened = open_store(str(empty))
    assert opened.servo("a").windows == 5
    opened.close()
    left = tmp_path / "gone.db"
    left.with_name("gone.db-wal").write_bytes(b"log")
    with pytest.raises(InvalidInput, match=r"its log gone\.db-wal exists"):
        restore(saved, str(left))
    store.close()


def test_a_damaged_or_newer_backup_is_not_restored(url: str, tmp_path: Path, later_scripts: Path) -> None:
    store, saved, to = filled(url, 40), tmp_path / "backup.db", tmp_path / "restored.db"
    backup(url, saved)
    whole = saved.read_bytes()
    middle = len(whole) // 2
    saved.write_bytes(whole[:middle] + os.urandom(20_000) + whole[middle + 20_000 :])
    with pytest.raises(InvalidInput):
        restore(saved, str(to))
    saved.write_bytes(whole[:middle])
    with pytest.raises(InvalidInput):
        restore(saved, str(to))
    # A row and its index disagree: every page can be read, and the copy is as bad as its source.
    places = [place for place in range(len(whole)) if whole.startswith(b"aboot/17", place)]
    assert places
    saved.write_bytes(b"".join((whole[: places[-1]], b"aboot/71", whole[places[-1] + 8 :])))
    with pytest.raises(InvalidInput, match="is damaged"):
        restore(saved, str(to))
    migrations.migrate(store.engines.writer, NEXT, later_scripts)
    store.close()
    shutil.copy(tmp_path / "store.db", saved)
    with pytest.raises(InvalidInput, match=f"newer than {REVISION}"):
        restore(saved, str(to))
    assert not to.exists()
    with pytest.raises(InvalidInput, match="there is no such file"):
        restore(tmp_path / "nothing.db", str(to))
    with pytest.raises(InvalidInput, match="call pg_restore"):
        restore(saved, "postgresql://u@h/d")


# Retention


@pytest.mark.slow
def test_retention_deletes_old_bodies_except_those_of_windows_that_led_to_an_update(new_address: NewAddress) -> None:
    store = open_store(new_address())
    store.put([window(sequence=n, body=bytes(1000), received=100.0 + n) for n in range(10)])
    store.put([letter(received=100.0)])
    (claim,) = store.lease("me", 1, 30.0, 200.0, per_servo=8)
    led = EvidenceRecord("update", claim.messages[2].id, b"", version=1)
    every = [EvidenceRecord("estimate", message.id, b"e") for message in claim.messages]
    store.commit([outcome(claim, led, *every)], 201.0)
    pauses: list[None] = []
    assert delete_old_bodies(store, 9, 3, lambda: pauses.append(None)) == RetentionResult(
        emptied=7, bytes=7000, retained=2
    )
    assert pauses
    bodies = {n: store.window("a", "boot", n).body for n in range(10)}
    assert [n for n, body in bodies.items() if body] == [2, 8, 9]
    assert len([link for link in store.audit("a") if link.evidence or link.steps]) == 8
    assert store.put([window(body=bytes(1000))]) == [PutResult.KNOWN]
    (rest,) = store.lease("me", 1, 30.0, 300.0)
    assert len(rest.messages) == 3
    assert delete_old_bodies(store, 9) == RetentionResult(0, 0, 2)
    store.close()


def test_retention_returns_space_to_the_file_system(url: str, tmp_path: Path) -> None:
    store = open_store(url)
    store.put([window(sequence=n, body=os.urandom(20_000), received=100.0) for n in range(100)])
    while claims := store.lease("me", 1, 30.0, 200.0):
        store.commit([outcome(claim) for claim in claims], 201.0)

    def pages() -> int:
        with transaction(store.engines.reader) as connection:
            return connection.exec_driver_sql("PRAGMA page_count").scalar_one()

    before = pages()
    assert delete_old_bodies(store, 1000, 10).emptied == 100
    assert pages() < before / 5
    store.close()


def test_interrupted_retention_continues_at_the_next_call(url: str) -> None:
    store = open_store(url)
    store.put([window(sequence=n, received=100.0) for n in range(10)])
    store.commit([outcome(claim) for claim in store.lease("me", 1, 30.0, 200.0)], 201.0)

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        delete_old_bodies(store, 1000, 4, stop)
    assert delete_old_bodies(store, 1000, 4).emptied == 6
    with transaction(store.engines.reader) as connection:
        assert connection.execute(sa.select(sa.func.count()).select_from(bodies)).scalar_one() == 0
    with pytest.raises(InvalidInput, match="must be at least 1"):
        delete_old_bodies(store, 1000, 0)
    store.close()
