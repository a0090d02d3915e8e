"""Damage that is found: pages, bodies, and messages that are gone."""

import math
import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from store_cases import claim, outcome, window

from servotwin.errors import InvalidInput
from servotwin.store.claims import StoredClaim
from servotwin.store.engine import StoreUnavailable, sqlite_file
from servotwin.store.integrity import (
    IntegrityReport,
    body_fault,
    check_all,
    check_bodies,
    check_pages,
    message_digest,
    missing_windows,
    newest_message,
    read_error,
)
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)
PAGE = 8192


def digested(sequence: int, body: bytes) -> object:
    return window(sequence=sequence, body=body)._replace(digest=message_digest(body))


def filled(url: str, windows: int = 40) -> Path:
    store = open_store(url)
    store.put([digested(n, os.urandom(20_000)) for n in range(windows)])
    file = sqlite_file(store.engines.writer.url)
    store.close()
    assert file is not None
    return file


def overwrite(file: Path, page: int, pages: int = 1) -> None:
    with file.open("r+b") as opened:
        opened.seek(page * PAGE)
        opened.write(os.urandom(pages * PAGE))


def test_a_sound_store_is_sound(store: Store) -> None:
    store.put([digested(n, b"%d" % n) for n in range(5)])
    assert check_pages(store, math.inf).faults == ()
    assert check_bodies(store, 0, 3)[0] == IntegrityReport((), False, 3)
    ids = newest_message(store)
    assert check_bodies(store, ids - 2, 3) == (IntegrityReport((), True, 2), ids)


def test_twenty_pages_of_rubbish_are_found(url: str) -> None:
    file = filled(url)
    overwrite(file, file.stat().st_size // PAGE // 2, 20)
    store = open_store(url)
    found = check_pages(store, math.inf)
    assert found.faults
    assert not found.complete
    store.close()


def test_a_page_of_zeros_is_found_in_every_table_and_index(url: str) -> None:
    file = filled(url, 2)
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    whole = file.read_bytes()
    for page in range(1, len(whole) // PAGE):  # the first one has the schema, without which no store opens
        file.write_bytes(whole[: page * PAGE] + bytes(PAGE) + whole[(page + 1) * PAGE :])
        assert faults(url), page + 1
    file.write_bytes(whole)
    assert faults(url) == ()


def faults(url: str) -> tuple[str, ...]:
    """Faults of a store's pages and bodies, or that it does not open."""
    try:
        store = open_store(url)
    except InvalidInput as error:
        return (str(error),)
    with closing(store):
        return check_pages(store, math.inf).faults or check_bodies(store, 0, 10)[0].faults


@pytest.mark.parametrize("changed", [b"other samples", b""])
def test_a_body_that_changed_is_found_by_its_digest(store: Store, changed: bytes) -> None:
    whole = digested(1, b"samples")
    store.put([digested(0, b"earlier"), whole._replace(body=changed)])
    result, _ = check_bodies(store, 0, 10)
    assert result.faults == (f"message {newest_message(store)} of servo 'a': its body differs from its digest",)


@pytest.mark.parametrize("column", ["body", "digest", "encoding"])
def test_a_column_that_became_of_another_type_is_damage(column: str) -> None:
    """One bit in the header of a row tells a text from bytes of the same length."""
    row = {"body": b"samples", "digest": message_digest(b"samples"), "encoding": ""}
    assert body_fault(1, "a", **row) == ""
    other = {"body": "samples", "digest": row["digest"].hex()[:16], "encoding": b"deflate"}[column]
    assert body_fault(1, "a", **{**row, column: other}) == "message 1 of servo 'a': its body differs from its digest"


def test_a_check_ends_in_time_and_says_so(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(url)
    monkeypatch.setattr("servotwin.store.integrity._STEPS", 1)
    store = open_store(url)
    result = check_pages(store, 0.0)
    assert (result.faults, result.complete) == ((), False)
    store.close()


def test_reading_a_damaged_page_says_damaged(url: str) -> None:
    file = filled(url)
    overwrite(file, 1, file.stat().st_size // PAGE - 1)
    with pytest.raises(InvalidInput, match="is damaged"):
        open_store(url)


def test_holes_in_the_sequences_of_a_boot_are_found(store: Store) -> None:
    store.put([window(sequence=n) for n in (0, 1, 4, 5, 9)])
    assert missing_windows(store, "a", "boot") == [(2, 3), (6, 8)]
    assert missing_windows(store, "a", "another") == missing_windows(store, "b", "boot") == []
    # Of so few of the newest windows the beginning is not known.
    assert missing_windows(store, "a", "boot", 3) == [(6, 8)]
    store.put([window("b", 3)])
    assert missing_windows(store, "b", "boot") == [(0, 2)]
    store.put([window(sequence=n) for n in (2, 3, 6, 7, 8)])
    assert missing_windows(store, "a", "boot") == []


def test_windows_that_were_sent_again_leave_no_hole_around_those_that_were_not(store: Store) -> None:
    # As after a backup was restored: the edge sends again what was lost, and later windows were stored before.
    store.put([window(sequence=n) for n in (3, 4, 5, 0, 1, 2, 6)])
    for newest in (3, 4, 5, 256):
        assert missing_windows(store, "a", "boot", newest) == []
    store.put([window(sequence=n) for n in (8, 9)])
    assert missing_windows(store, "a", "boot", 6) == [(7, 7)]


def test_a_message_is_posted_to_an_edge_besides_results(store: Store) -> None:
    store.put([window()])
    store.post({"a": b"asking", "unknown": b"lost"}, 100.0)
    store.post({"a": b"again"}, 100.0)
    assert [(each.serial, each.body) for each in store.outgoing("a", 0)] == [(1, b"asking"), (2, b"again")]
    assert store.posted(["a", "unknown"]) == {"a": 2}


def test_a_damaged_store_is_read_and_not_written(store: Store) -> None:
    store.put([window()])
    store.commit([outcome(one) for one in claim(store)], 200.0)
    before = newest_message(store), store.posted(["a"]), store.claim_of("a"), check_bodies(store, 0, 3)[0].checked
    store.damaged = True
    try:
        for write in (
            lambda: store.put([window(sequence=1)]),
            lambda: store.post({"a": b"asking"}, 100.0),
            lambda: store.raise_claim("a", StoredClaim("run", 1), 1, 100.0),
            lambda: store.hold("a", 100.0),
            lambda: delete_old_bodies(store, 10**9),
        ):
            with pytest.raises(StoreUnavailable, match="is damaged and not written any more"):
                write()
    finally:
        store.damaged = False
    after = newest_message(store), store.posted(["a"]), store.claim_of("a"), check_bodies(store, 0, 3)[0].checked
    assert after == before


def test_an_error_that_passes_is_no_damage(url: str, caplog: pytest.LogCaptureFixture) -> None:
    """The file cannot be opened for a moment; the next check finds the store sound."""
    file = filled(url, 2)
    store = open_store(url)
    aside = file.rename(file.with_suffix(".aside"))
    assert check_pages(store, math.inf) == IntegrityReport((), False, 0)
    assert "store not checked" in caplog.messages
    aside.rename(file)
    assert check_pages(store, math.inf).complete
    store.close()


def test_a_disk_that_does_not_give_a_file_is_told_from_damage(tmp_path):
    file = filled(f"sqlite:///{tmp_path}/twin.db", 3)
    with closing(open_store(str(file))) as store:
        assert read_error(store) == ""
        overwrite(file, 1)
        assert read_error(store) == ""
    file.unlink()
    file.symlink_to("/proc/self/mem")  # whose first bytes belong to nothing, so that reading them is an I/O error
    assert read_error(store) == f"Input/output error, in {file}"


def test_a_check_of_everything_finds_each_kind_of_damage(tmp_path):
    file = filled(f"sqlite:///{tmp_path}/twin.db", 300)
    with closing(open_store(str(file))) as store:
        assert check_all(store) == IntegrityReport((), True, 300)
        assert not check_all(store, lambda: True).complete
        with store.engines.writer.begin() as connection:
            connection.exec_driver_sql("UPDATE bodies SET body = x'00' WHERE message = 299")
        assert "message 299" in check_all(store).faults[0]
        file.rename(tmp_path / "moved")
        assert "deleted, moved or replaced" in check_all(store).faults[0]
