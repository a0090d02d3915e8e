"""An outbox that was corrupted between two runs: what can be read is sent, the rest is counted, the file stays."""

import errno
import os
import shutil
import sqlite3
import time
import tracemalloc
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from outbox_cases import filled, window

from servotwin.link import rebuild, sqlite_outbox
from servotwin.link.outbox_contents import BROKEN, UNWRITABLE
from servotwin.link.outbox_index import AcknowledgedLimits, LastStatus
from servotwin.link.salvage import salvage
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import encode
from servotwin.messages.codec import deflated

WINDOWS = 80


def overwrite(path: Path, pages: list[int], size: int = 4096) -> None:
    with path.open("r+b") as file:
        for page in pages:
            file.seek(size * (page - 1))
            file.write(os.urandom(size))


def leaves(path: Path) -> list[int]:
    """Pages on which rows of the windows begin."""
    data = path.read_bytes()
    return [k + 1 for k in range(1, len(data) // 4096) if data[4096 * k] == 13]


def numbers_kept(path: Path) -> set[int]:
    """Numbers of the windows that are kept although they were acknowledged."""
    with closing(sqlite3.connect(path)) as file:
        return {number for (number,) in file.execute("SELECT sequence FROM acknowledged")}


def reopened(path: Path, waiting: int = 0) -> SqliteOutbox:
    box = SqliteOutbox(path, "axis-1", last=LastStatus(waiting))
    assert box.flushed
    return box


@pytest.mark.parametrize("number", [1, 3])
def test_damaged_pages_lose_their_own_windows_which_are_counted(tmp_path: Path, number: int) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[3 : 3 + number])
    box = reopened(path)
    [found] = box.salvages
    assert found.rescued == len(box.pending()) >= WINDOWS - 8 * number
    assert found.lost == WINDOWS - found.rescued > 0
    assert box.dropped == {BROKEN: found.lost}
    assert found.file.name == "outbox.sqlite.broken-1"
    assert found.file.exists()
    for key in box.pending():
        assert box.get(key) == window(key[1])
    assert box.pending() == sorted(box.pending(), key=lambda key: key[1])
    box.close()
    again = reopened(path)
    assert (len(again.pending()), again.salvages, again.dropped) == (found.rescued, [], {BROKEN: found.lost})
    again.close()


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def keys_read(path: Path) -> set[tuple[str, int]]:
    """Windows that are read of a corrupt file; each is handed on once."""
    given: list[tuple[str, int]] = []
    found = salvage(path, lambda row: given.append(row[1:3]))
    assert len(given) == len(found.windows) == len(set(given) | found.windows)
    return found.windows


def without_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """No room for another file."""
    monkeypatch.setattr(shutil, "copyfile", full)
    monkeypatch.setattr(rebuild, "_open", full)


def test_without_room_for_another_file_the_windows_wait_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[3:4])
    with_room = keys_read(path)
    before = path.read_bytes()
    without_room(monkeypatch)
    box = reopened(path)
    [found] = box.salvages
    assert set(box.pending()) == with_room
    assert found.rescued == WINDOWS - found.lost >= WINDOWS - 8
    assert found.file.read_bytes() == before
    box.close()


def test_without_room_the_newest_windows_that_memory_may_hold_are_kept_and_the_others_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[40:41])
    without_room(monkeypatch)
    monkeypatch.setattr(sqlite_outbox, "MOST_UNWRITTEN", 10 * len(deflated(encode(window(0)))[0]))
    box = reopened(path)
    assert 8 <= len(box.pending()) <= 10
    assert box.pending()[-1] == ("b0", WINDOWS - 1)
    assert box.dropped[UNWRITABLE] > 50
    assert len(box.pending()) + box.dropped[UNWRITABLE] + box.dropped[BROKEN] == WINDOWS
    box.close()


def killed(folder: Path, windows: int, of_log: int) -> Path:
    """The files of a link process that was killed: its newest windows are in the write-ahead log only."""
    filled(folder, windows)
    box = SqliteOutbox(folder / "outbox.sqlite", "axis-1")
    for k in range(windows, windows + of_log):
        box.put(window(k))
    copy = folder / "killed"
    copy.mkdir()
    for end in ("", "-wal"):
        shutil.copyfile(folder / f"outbox.sqlite{end}", copy / f"outbox.sqlite{end}")
    box.close()
    return copy / "outbox.sqlite"


@pytest.mark.parametrize("room", [True, False])
def test_windows_that_are_only_in_the_log_are_rescued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: bool
) -> None:
    path = killed(tmp_path, 30, 10)
    overwrite(path, leaves(path)[3:4])
    if not room:
        without_room(monkeypatch)
    box = reopened(path)
    [found] = box.salvages
    assert found.rescued + found.lost == 40
    assert found.lost <= 8
    assert {("b0", k) for k in range(30, 40)} <= set(box.pending())
    assert [box.get(("b0", k)) for k in range(30, 40)] == [window(k) for k in range(30, 40)]
    box.close()


@pytest.mark.slow
def test_a_large_outbox_is_rescued_in_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    samples, windows = 30_000, 120  # 55 kB each
    path = tmp_path / "outbox.sqlite"
    monkeypatch.setattr(rebuild, "_BATCH", 300_000)
    original = window(0, samples)
    box = SqliteOutbox(path, "axis-1")
    with box.transaction():
        for k in range(windows):
            box.put(msgspec.structs.replace(original, sequence=k))
    box.close()
    pages = path.stat().st_size // 4096
    overwrite(path, [pages // 2])
    tracemalloc.start()
    try:
        box = reopened(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert box.salvages[0].rescued >= windows - 3
    assert box.salvages[0].rescued + box.salvages[0].lost == windows
    assert path.stat().st_size > 5_000_000 > 5 * peak
    box.close()


@pytest.mark.parametrize("step", ["while it is written", "before the first rename", "between the renames"])
def test_an_edge_that_is_killed_while_it_rescues_windows_loses_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[3:4])
    expected = keys_read(path)

    class Killed(BaseException):
        pass

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        if step == "while it is written":
            patch.setattr(rebuild, "_BATCH", 20_000)
            commits = iter(range(3))
            commit = rebuild._NewFile.commit
            patch.setattr(rebuild._NewFile, "commit", lambda file: commit(file) if next(commits, None) else kill())
        else:
            patch.setattr(rebuild, "put_aside" if step == "before the first rename" else "adopt", kill)
        with pytest.raises(Killed):
            SqliteOutbox(path, "axis-1")
    box = reopened(path)
    assert set(box.pending()) == expected
    assert box.dropped == {BROKEN: WINDOWS - len(expected)}
    assert box.number("cursor") == 7
    assert len(box.letters()) == 1
    assert [each.name for each in tmp_path.iterdir() if "new" in each.name or "salvage" in each.name] == []
    box.close()


def test_on_a_read_only_disk_lost_windows_are_counted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[3:4])
    without_room(monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(rebuild, "put_aside", full)
        box = SqliteOutbox(path, "axis-1")
        dropped, pending = dict(box.dropped), box.pending()
        for _ in range(3):
            assert not box.flush()
        assert (dict(box.dropped), box.pending(), box.faults[BROKEN]) == (dropped, pending, 1)
        assert box.get(pending[0]) == window(pending[0][1])
    assert box.flush()
    assert (dict(box.dropped), box.pending(), len(box.salvages)) == (dropped, pending, 1)
    box.close()


def test_windows_that_were_acknowledged_are_not_salvaged(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(10**7, 3600.0))
    for k in range(WINDOWS):
        box.put(window(k))
    for k in (*range(30), *range(50, WINDOWS)):  # the first and the last ones
        box.remove(("b0", k))
    box.close()
    overwrite(path, leaves(path)[-3:-2])
    found = salvage(path, lambda _: None)
    rescued = found.windows
    assert rescued | found.lost == {("b0", k) for k in range(30, 50)}
    assert len(rescued) >= 12


def test_acknowledged_windows_do_not_count_as_lost_though_the_last_status_has_them_as_waiting(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(10**7, 3600.0))
    for k in range(WINDOWS):
        box.put(window(k))
        box.remove(("b0", k))
    box.close()
    overwrite(path, leaves(path)[3:4])
    box = reopened(path, waiting=5)
    assert (box.pending(), box.dropped) == ([], {})
    assert [found.lost for found in box.salvages] == [0]
    box.close()


def test_a_damaged_first_page_loses_no_window(tmp_path: Path) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, [1])
    box = reopened(path)
    assert [sequence for _, sequence in box.pending()] == list(range(WINDOWS))
    assert box.number("cursor") == 7
    assert len(box.letters()) == 1
    assert box.dropped == {}
    box.close()


@pytest.mark.slow
def test_where_nothing_can_be_read_the_last_status_tells_how_many_windows_are_lost(tmp_path: Path) -> None:
    path = filled(tmp_path, WINDOWS)
    path.write_bytes(os.urandom(path.stat().st_size))
    box = reopened(path, waiting=WINDOWS)
    assert box.pending() == []
    assert box.dropped == {BROKEN: WINDOWS}
    box.close()


def test_a_window_that_was_changed_on_the_disk_is_lost_and_not_sent(tmp_path: Path) -> None:
    path = filled(tmp_path, 5)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE windows SET body = zeroblob(200) WHERE sequence = 2")
    connection.close()
    overwrite(path, [1])
    box = reopened(path)
    assert [sequence for _, sequence in box.pending()] == [0, 1, 3, 4]
    assert box.dropped == {BROKEN: 1}
    box.close()


def test_an_acknowledged_window_is_kept_and_sent_again_when_the_twin_asks(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    size = 0
    for run in range(2):
        box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(10**6, 3600.0))
        if run == 0:
            for k in range(6):
                box.put(window(k))
            size = len(box.parcel(("b0", 0)).body)
            for k in range(5):
                assert box.remove(("b0", k))
                assert not box.remove(("b0", k))
            box.put(window(3))
        assert box.pending() == [("b0", 5)]
        if run == 1:
            assert box.resend(lambda boot, sequence: boot == "b0" and 2 <= sequence <= 3) == 2
            assert sorted(box.pending()) == [("b0", 2), ("b0", 3), ("b0", 5)]
            assert box.get(("b0", 2)) == window(2)
            box.remove(("b0", 2))
            assert box.resend(lambda *_: True) == 4
        box.close()
    few = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(int(2.5 * size), 3600.0))
    for key in few.pending():
        few.remove(key)
    assert few.resend(lambda *_: True) == 2
    few.close()


def test_acknowledged_windows_stay_for_a_running_time_whatever_the_clock_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two windows an hour, kept for ten; the clock is 75 days ahead at every second start, and then right again."""
    path, running, acknowledged = tmp_path / "outbox.sqlite", 0.0, 0
    for start in range(6):
        monkeypatch.setattr(time, "time", lambda: 1.8e9 + running + 75.0 * 86400.0 * (start % 2))  # noqa: B023
        begun, boot = running, 1000.0 * start  # a monotonic clock begins anywhere
        box = SqliteOutbox(
            path,
            "axis-1",
            kept=AcknowledgedLimits(10**7, 36_000.0),
            clock=lambda: boot + running - begun,  # noqa: B023
        )
        for _ in range(12):
            running += 1800.0
            box.put(window(acknowledged))
            box.remove(("b0", acknowledged))
            acknowledged += 1
            # A start loses the time since the acknowledgement before it: half an hour at most.
            assert min(acknowledged, 21) <= len(numbers_kept(path)) <= 21 + min(start, 2)
        box.close()


def test_files_with_times_of_day_are_read(tmp_path: Path) -> None:
    """Versions before noted the time of day of an acknowledgement."""
    path, limits = tmp_path / "outbox.sqlite", AcknowledgedLimits(10**6, 3600.0)
    box = SqliteOutbox(path, "axis-1", kept=limits)
    for k in range(4):
        box.put(window(k))
    box.remove(("b0", 0))
    box.remove(("b0", 1))
    box.close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE acknowledged SET at = 1.8e9 + 3000.0 * sequence")
    now = 5.0
    box = SqliteOutbox(path, "axis-1", kept=limits, clock=lambda: now)
    box.remove(("b0", 2))
    assert numbers_kept(path) == {0, 1, 2}
    now += 700.0
    box.remove(("b0", 3))
    assert numbers_kept(path) == {1, 2, 3}
    box.close()


def test_only_its_owner_may_open_an_outbox(tmp_path: Path) -> None:
    path = filled(tmp_path, 1)
    assert path.stat().st_mode & 0o777 == 0o600
    path.chmod(0o644)
    reopened(path).close()
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_corrupt_file_of_another_servo_is_put_aside_with_what_can_be_read_of_it(tmp_path: Path) -> None:
    path = filled(tmp_path, WINDOWS)
    overwrite(path, leaves(path)[3:6])
    box = SqliteOutbox(path, "axis-2")
    assert (box.flushed, box.pending(), box.letters(), box.dropped) == (True, [], [], {})
    assert box.number("cursor") == 0
    box.close()
    [broken], [other] = box.salvages, box.others
    assert (other.servo, other.waiting, broken.rescued + broken.lost) == ("axis-1", broken.rescued, WINDOWS)
    with closing(SqliteOutbox(other.file, "axis-1")) as aside:
        assert [aside.get(key) for key in aside.pending()] == [window(key[1]) for key in aside.pending()]


def test_a_name_that_is_no_text_loses_its_own_window_only(tmp_path: Path) -> None:
    path = filled(tmp_path, WINDOWS)
    with closing(sqlite3.connect(path)) as file:
        file.execute("UPDATE windows SET boot = CAST(x'6230ff' AS TEXT) WHERE sequence = 5")
        file.commit()
    box = SqliteOutbox(path, "axis-1", last=LastStatus(WINDOWS))
    assert box.flushed
    assert [sequence for _, sequence in box.pending()] == [k for k in range(WINDOWS) if k != 5]
    assert (box.salvages[0].file.name, box.dropped) == ("outbox.sqlite.broken-1", {BROKEN: 1})
    box.close()
