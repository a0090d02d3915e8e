"""The outbox on disk: what was put survives kill -9; full, unwritable or broken disks are counted and survived."""

import os
import resource
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.link.outbox import FULL, Dropped
from servotwin.link.outbox_contents import BROKEN, UNWRITABLE
from servotwin.link.outbox_index import AcknowledgedLimits
from servotwin.link.session import Session
from servotwin.link.sqlite_file import connect
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import WindowMessage, checksum, pack_channel
from servotwin.runtime.retry import Retry


def window(sequence: int, reason: str = "reference", samples: int = 50, boot: str = "b0") -> WindowMessage:
    noise = [((k * 7919 + sequence) % 997) * 1e-6 for k in range(samples)]
    channels = (pack_channel("position", "m", noise),)
    return WindowMessage("axis-1", boot, sequence, 0.0, 10.0, channels, (), 0, "", reason, checksum(channels))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "outbox.sqlite"


@pytest.fixture
def outbox(path: Path) -> Iterator[SqliteOutbox]:
    box = SqliteOutbox(path, "axis-1")
    yield box
    box.close()


def again(box: SqliteOutbox, path: Path, **limits: int) -> SqliteOutbox:
    box.close()
    return SqliteOutbox(path, "axis-1", **limits)


def sequences(box: SqliteOutbox) -> list[int]:
    return [sequence for _, sequence in box.pending()]


def test_an_outbox_has_its_messages_after_a_restart(outbox: SqliteOutbox, path: Path) -> None:
    for k in range(3):
        assert outbox.put(window(k)) == []
    assert outbox.flushed
    assert outbox.remove(("b0", 1))
    assert not outbox.remove(("b0", 1))
    outbox.put_letter(b"letter")
    outbox.put_letter(b"letter")
    outbox.set_number("cursor", 7)
    fresh = again(outbox, path)
    assert sequences(fresh) == [0, 2]
    assert [fresh.get(key) for key in fresh.pending()] == [window(0), window(2)]
    with pytest.raises(KeyError):
        fresh.get(("b0", 1))
    (digest,) = fresh.letters()
    assert fresh.letter(digest).body == b"letter"
    assert fresh.number("cursor") == 7
    fresh.remove_letter(digest)
    last = again(fresh, path)
    assert (last.letters(), last.number("never")) == ([], 0)
    last.close()


def test_a_sqlite_outbox_works_with_a_session(outbox: SqliteOutbox) -> None:
    session = Session(outbox, Retry(1.0))
    outbox.put(window(0))
    (key,) = session.due(0.0)
    assert isinstance(key, tuple)
    assert outbox.get(key) == window(0)
    session.retry_later(key, 0.0)
    assert session.next_time == 1.0


def test_a_window_put_twice_is_stored_once(outbox: SqliteOutbox) -> None:
    outbox.put(window(0))
    outbox.put(window(0))
    assert sequences(outbox) == [0]


def test_a_full_outbox_drops_the_oldest_uninformative_window_first(outbox: SqliteOutbox, path: Path) -> None:
    box = again(outbox, path, windows=3)
    for k, reason in enumerate(["reference", "periodic", "probe", "periodic, as every hour"]):
        drops = box.put(window(k, reason))
    assert drops == [Dropped(("b0", 1), FULL)]
    assert box.put(window(4)) == [Dropped(("b0", 3), FULL)]
    assert box.put(window(5)) == [Dropped(("b0", 0), FULL)]
    assert box.put(window(6, "periodic")) == [Dropped(("b0", 6), FULL)]
    assert sequences(box) == [2, 4, 5]
    fresh = again(box, path, windows=3)
    assert fresh.dropped == {FULL: 4}
    assert sequences(fresh) == [2, 4, 5]
    fresh.close()


def test_bytes_are_bounded_too(outbox: SqliteOutbox, path: Path) -> None:
    outbox.put(window(0, samples=2000))
    size = len(outbox.parcel(("b0", 0)).body)
    box = again(outbox, path, size=int(2.5 * size))
    for k in range(1, 6):
        box.put(window(k, samples=2000))
    assert len(box.pending()) == 2
    assert box.dropped == {FULL: 4}
    box.close()


PUT_UNTIL_KILLED = """
import os, sys
from pathlib import Path
from test_sqlite_outbox import window
from servotwin.link.sqlite_outbox import SqliteOutbox

box = SqliteOutbox(Path(sys.argv[1]), "axis-1")
for k in range(100000):
    box.put(window(k))
    if k % 3 == 2:
        box.remove(("b0", k - 2))
    print(k, flush=True)
"""


def test_kill_9_loses_no_message_in_the_outbox(path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(Path(__file__).parent), *sys.path))}
    command = [sys.executable, "-c", PUT_UNTIL_KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if int(line) >= 40:
                child.send_signal(signal.SIGKILL)
                break
        put = [int(line), *(int(each) for each in child.stdout.read().splitlines())]
    box = SqliteOutbox(path, "axis-1")
    found = set(sequences(box))
    assert {k for k in range(put[-1] + 1) if k % 3 != 0} <= found
    assert all(box.get(("b0", k)) == window(k) for k in found)
    box.close()


def test_a_full_disk_is_counted_and_survived(outbox: SqliteOutbox, path: Path) -> None:
    """A limit on the size of files stands for the disk; the database grows into it."""
    outbox.put(window(0))
    outbox.set_number("cursor", 3)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, before[1]))
    try:
        for k in range(1, 40):
            outbox.put(window(k, samples=5000))
        assert not outbox.flushed
        assert outbox.faults[UNWRITABLE] > 0
        assert outbox.trouble
        assert sequences(outbox) == list(range(40))
        assert outbox.get(("b0", 39)) == window(39, samples=5000)
        assert outbox.remove(("b0", 5))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert outbox.flush()
    assert outbox.flushed
    assert outbox.trouble == ""
    fresh = again(outbox, path)
    assert sequences(fresh) == [k for k in range(40) if k != 5]
    assert (fresh.number("cursor"), fresh.dropped) == (3, {})
    fresh.close()


def test_a_read_only_file_is_counted_and_survived(
    outbox: SqliteOutbox, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A connection opened on a disk that is read-only stays so when the disk no longer is."""

    def read_only(*arguments: Any, **options: Any) -> sqlite3.Connection:
        made = connect(*arguments, **options)
        made.execute("PRAGMA query_only = ON")
        return made

    outbox.put(window(0))
    outbox.close()
    with monkeypatch.context() as patch:
        for module in ("sqlite_file", "sqlite_outbox"):
            patch.setattr(f"servotwin.link.{module}.connect", read_only)
        outbox.flush()
        outbox.put(window(1))
        outbox.put_letter(b"letter")
        outbox.remove(("b0", 0))
        assert (sequences(outbox), outbox.flushed) == ([1], False)
        assert not outbox.flush()
        assert "readonly" in outbox.trouble
    assert outbox.flush()
    fresh = again(outbox, path)
    assert (sequences(fresh), len(fresh.letters())) == ([1], 1)
    fresh.close()


def test_a_missing_folder_does_not_stop_the_outbox(tmp_path: Path) -> None:
    path = tmp_path / "later" / "outbox.sqlite"
    box = SqliteOutbox(path, "axis-1")
    box.put(window(0))
    assert not box.flushed
    path.parent.mkdir()
    assert box.flush()
    fresh = again(box, path)
    assert sequences(fresh) == [0]
    fresh.close()


def test_unwritten_windows_in_memory_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servotwin.link.sqlite_outbox.MOST_UNWRITTEN", 1000)
    box = SqliteOutbox(tmp_path / "never" / "outbox.sqlite", "axis-1")
    for k in range(50):
        box.put(window(k))
    assert box.dropped[UNWRITABLE] + len(box.pending()) == 50
    assert 0 < len(box.pending()) < 50
    assert sequences(box)[-1] == 49


@pytest.mark.parametrize("wal", [False, True])
def test_a_corrupt_file_is_put_aside(outbox: SqliteOutbox, path: Path, wal: bool) -> None:
    outbox.put(window(0))
    outbox.close()
    path.write_bytes(b"no database at all" * 100)
    if wal:
        path.with_name(path.name + "-wal").write_bytes(b"rubbish" * 50)
    fresh = SqliteOutbox(path, "axis-1")
    fresh.put(window(1))
    assert fresh.flushed
    assert sequences(fresh) == [1]
    assert fresh.faults == {BROKEN: 1}
    assert fresh.number(BROKEN) == 1
    assert (path.parent / "outbox.sqlite.broken-1").read_bytes().startswith(b"no database")
    fresh.close()


@pytest.mark.slow
def test_a_file_corrupted_while_open_is_put_aside_and_its_windows_are_counted(outbox: SqliteOutbox, path: Path) -> None:
    for k in range(30):
        outbox.put(window(k, samples=3000))
    assert outbox._connection is not None
    outbox._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    outbox._connection.execute("PRAGMA cache_size = 0")
    with path.open("r+b") as file:
        file.seek(100)
        file.write(os.urandom(path.stat().st_size - 100))
    for k in range(30, 40):
        outbox.put(window(k))
    assert outbox.faults[BROKEN] == 1
    assert outbox.dropped[BROKEN] + len(outbox.pending()) == 40
    assert sequences(outbox)[-1] == 39
    fresh = again(outbox, path)
    assert sequences(fresh)[-1] == 39
    fresh.close()


STEPS = st.lists(st.tuples(st.sampled_from("prdlt"), st.integers(0, 9), st.booleans()), max_size=30)


@pytest.mark.slow
@examples(40, deadline=None)
@given(steps=STEPS)
def test_every_window_is_kept_removed_or_counted(tmp_path_factory: pytest.TempPathFactory, steps: list) -> None:
    path = tmp_path_factory.mktemp("box") / "outbox.sqlite"
    box = SqliteOutbox(path, "axis-1", windows=4)
    put, removed, letters = 0, 0, set()
    for kind, number, restart in steps:
        if kind == "p":
            box.put(window(put, "periodic" if number % 2 else "reference"))
            put += 1
        elif kind == "r":
            removed += box.remove(("b0", number))
        elif kind == "d":
            box.drop(("b0", number), "too_large")
        elif kind == "l":
            box.put_letter(bytes([number]))
            letters.add(number)
        elif box.letters():
            digest = box.letters()[0]
            letters.discard(box.letter(digest).body[0])
            box.remove_letter(digest)
        if restart:
            box = again(box, path, windows=4)
        assert put == removed + len(box.pending()) + sum(box.dropped.values())
        assert (box.waiting, box.oldest()) == (len(box.pending()), next(iter(box.pending()), None))
        assert {box.letter(digest).body[0] for digest in box.letters()} == letters
        assert all(box.get(key).identity[1:] == key for key in box.pending())
    box.close()
    with sqlite3.connect(path) as connection:
        assert connection.execute("SELECT count(*) FROM windows").fetchone()[0] == len(box.pending())
    connection.close()


def acknowledged(path: Path, number: int, **limits: int) -> SqliteOutbox:
    """An outbox with windows that are acknowledged and kept."""
    box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(10**6, 3600.0), **limits)
    for k in range(number):
        box.put(window(k, "periodic"))
        box.remove(("b0", k))
    return box


def test_windows_that_the_twin_asks_for_again_go_after_those_that_it_never_had(path: Path) -> None:
    box = acknowledged(path, 3)
    box.put(window(3, "periodic"))
    assert box.resend(lambda *_: True) == 3
    box.put(window(4))
    for _ in range(2):
        assert sequences(box) == [3, 4, 0, 1, 2]
        assert box.get(("b0", 1)) == window(1, "periodic")
        box.close()
        box = SqliteOutbox(path, "axis-1", kept=AcknowledgedLimits(10**6, 3600.0))
    box.remove(("b0", 0))
    box.drop(("b0", 1), "refused")
    assert box.resend(lambda *_: True) == 1
    assert sequences(box) == [3, 4, 2, 0]
    box.close()
    box = SqliteOutbox(path, "axis-1")
    assert sorted(sequences(box)) == [0, 2, 3, 4]
    box.close()


def test_windows_that_the_twin_asks_for_again_take_no_room_from_others(path: Path) -> None:
    box = acknowledged(path, 8, windows=10)
    for k in range(8, 17):
        box.put(window(k, "periodic"))
    assert box.resend(lambda *_: True) == 1
    assert sequences(box) == [*range(8, 17), 7]
    assert box.put(window(17)) == []
    assert sequences(box) == [*range(8, 18)]
    assert box.put(window(18)) == [Dropped(("b0", 8), FULL)]
    assert box.dropped == {FULL: 1}
    for k in range(9, 19):
        box.remove(("b0", k))
    # What gave way is still there for the next request.
    assert box.resend(lambda _, sequence: sequence < 8) == 8
    box.close()
