"""An outbox whose files are deleted, moved or replaced while it is open: what waits in it goes into a new file."""

import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from outbox_cases import window

from servotwin.link import moved_file
from servotwin.link.outbox_index import AcknowledgedLimits
from servotwin.link.sqlite_outbox import MOVED, SqliteOutbox


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "outbox.sqlite"


@pytest.fixture
def outbox(path: Path) -> Iterator[SqliteOutbox]:
    box = SqliteOutbox(path, "axis-1")
    yield box
    box.close()


def sequences(box: SqliteOutbox) -> list[int]:
    return [sequence for _, sequence in box.pending()]


def files_of(path: Path) -> list[Path]:
    return sorted(path.parent.glob(f"{path.name}*"))


def fill(box: SqliteOutbox, number: int = 20) -> None:
    for k in range(number):
        box.put(window(k, samples=1000))
    box.put_letter(b"letter")
    box.set_number("cursor", 7)


def assert_holds_all(box: SqliteOutbox, path: Path, number: int) -> None:
    """Both the open outbox and one that is opened after a kill have everything."""
    assert sequences(box) == list(range(number))
    copy = path.parent / "after-a-kill"
    copy.mkdir()
    for file in files_of(path):
        shutil.copy(file, copy / file.name)
    fresh = SqliteOutbox(copy / path.name, "axis-1")
    assert sequences(fresh) == list(range(number))
    assert all(fresh.get(("b0", k)) == window(k, samples=1000) for k in range(number))
    assert (fresh.number("cursor"), len(fresh.letters()), fresh.dropped) == (7, 1, {})
    fresh.close()


def test_deleted_files_are_written_anew_with_all_that_waits(outbox: SqliteOutbox, path: Path) -> None:
    fill(outbox)
    for file in files_of(path):
        file.unlink()
    assert outbox.flush()
    assert (outbox.faults[MOVED], outbox.moves[0].files) == (1, ("outbox.sqlite", "outbox.sqlite-wal"))
    assert_holds_all(outbox, path, 20)
    assert outbox.flush()
    assert outbox.faults[MOVED] == 1
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_window_that_comes_after_the_files_were_deleted_is_in_the_new_ones(outbox: SqliteOutbox, path: Path) -> None:
    fill(outbox)
    for file in files_of(path):
        file.unlink()
    outbox.put(window(20, samples=1000))
    assert outbox.flushed
    assert_holds_all(outbox, path, 21)


@pytest.mark.parametrize("log_too", [False, True])
def test_moved_files_keep_what_they_had(outbox: SqliteOutbox, path: Path, log_too: bool) -> None:
    fill(outbox)
    elsewhere = path.parent / "elsewhere"
    elsewhere.mkdir()
    for file in files_of(path) if log_too else [path]:
        file.rename(elsewhere / file.name)
    assert outbox.flush()
    assert_holds_all(outbox, path, 20)
    former = SqliteOutbox(elsewhere / path.name, "axis-1")
    assert sequences(former) == list(range(20))
    former.close()


def test_a_deleted_log_costs_nothing(outbox: SqliteOutbox, path: Path) -> None:
    fill(outbox)
    path.with_name(path.name + "-wal").unlink()
    assert outbox.flush()
    assert outbox.moves[0].files == ("outbox.sqlite-wal",)
    assert_holds_all(outbox, path, 20)


def test_a_file_in_the_place_of_the_open_one_is_put_aside_with_its_log(outbox: SqliteOutbox, path: Path) -> None:
    fill(outbox)
    other = SqliteOutbox(path.parent / "other.sqlite", "axis-1")
    other.put(window(99))
    for end in ("", "-wal", "-shm"):
        (path.parent / f"other.sqlite{end}").rename(path.with_name(path.name + end))
    assert outbox.flush()
    assert outbox.moves[0].aside == path.with_name("outbox.sqlite.another-1")
    assert_holds_all(outbox, path, 20)
    other.close()
    put_aside = SqliteOutbox(path.with_name("outbox.sqlite.another-1"), "axis-1")
    assert sequences(put_aside) == [99]
    put_aside.close()


def test_without_room_for_another_file_the_outbox_says_that_nothing_is_safe(
    outbox: SqliteOutbox, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(outbox)
    for file in files_of(path):
        file.unlink()
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patched:
        patched.setattr(moved_file, "_require_room", lambda *_: (_ for _ in ()).throw(full))
        assert not outbox.flush()
        assert "outbox.sqlite" in outbox.trouble
        assert "No space left on device" in outbox.trouble
        assert (outbox.put(window(20, samples=1000)), outbox.flushed) == ([], False)
        assert outbox.get(("b0", 3)) == window(3, samples=1000)
        assert outbox.remove(("b0", 0))
    assert outbox.flush()
    assert (outbox.trouble, outbox.faults[MOVED]) == ("", 1)
    assert sequences(outbox) == list(range(1, 21))
    outbox.close()
    fresh = SqliteOutbox(path, "axis-1")
    assert sequences(fresh) == list(range(1, 21))
    fresh.close()


def test_an_edge_that_is_killed_while_it_writes_the_files_anew_does_not_begin_on_half_of_them(
    outbox: SqliteOutbox, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(outbox)
    for file in files_of(path):
        file.unlink()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(moved_file, "adopt", killed)
        with pytest.raises(KeyboardInterrupt):
            outbox.flush()
    fresh = SqliteOutbox(path, "axis-1")
    assert sequences(fresh) == list(range(20))
    fresh.close()


def test_windows_that_were_acknowledged_stay_in_the_new_file(path: Path) -> None:
    box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(1_000_000, 1000.0))
    for k in range(3):
        box.put(window(k))
    box.remove(("b0", 1))
    path.unlink()
    box.flush()
    assert (sequences(box), box.resend(lambda *_: True), sequences(box)) == ([0, 2], 1, [0, 2, 1])
    assert box.get(("b0", 1)) == window(1)
    box.close()
