"""A folder of an edge that was copied: both link processes run against a twin's service, over HTTP."""

import shutil
import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from threading import Thread

import pytest
from edge_process_parts import EDGE, cut
from service_system import TOKEN, twin_file
from services import service
from waiting import PATIENCE, until

from servotwin.edge_process import frames
from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_process import LinkProcess
from servotwin.edge_process.monitoring import read_status
from servotwin.runtime.frames import FrameSocket


class Edge:
    """A link process in a thread, and the control process's end."""

    def __init__(self, folder: Path, run: str) -> None:
        self.folder, self.run, (ours, theirs) = folder, run, socket.socketpair()
        self.pipe, self.sent, self.superseded = FrameSocket(ours), 0, False
        self.thread = Thread(target=LinkProcess(load(folder / "edge.toml"), theirs, run).run)
        self.thread.start()

    def send(self, samples: int = 10) -> None:
        self.pipe.post(frames.encode(frames.window_frame(cut(self.sent, samples), self.run, self.sent + 1)))
        self.sent += 1
        while self.pipe.backlog:
            self.pipe.send()

    def heard(self) -> bool:
        """True once the control process was told that another edge has taken over."""
        found = [frames.to_control(data) for data in self.pipe.receive()]
        self.superseded |= any(isinstance(frame, frames.SupersededFrame) for frame in found)
        return self.superseded

    @property
    def status(self) -> dict:
        return read_status(self.folder / "status.json") or {}


@contextmanager
def edge(folder: Path, run: str) -> Iterator[Edge]:
    one = Edge(folder, run)
    try:
        yield one
    finally:
        one.pipe.close()
        one.thread.join(PATIENCE)


def query(folder: Path, text: str) -> list[tuple]:
    """Rows of a twin's store."""
    with closing(sqlite3.connect(f"file:{folder / 'twin.db'}?mode=ro", uri=True)) as database:
        return database.execute(text).fetchall()


def stored_windows(folder: Path) -> set[tuple[str, int]]:
    return set(query(folder, "SELECT boot, sequence FROM messages WHERE kind = 'window'"))


@pytest.mark.slow
def test_a_copied_folder_has_one_live_edge_and_both_sides_alarm(tmp_path: Path) -> None:
    """The copy takes over; the first one sends nothing more, keeps its window, and both say so; nothing is mixed."""

    asked, stored = partial(query, tmp_path), partial(stored_windows, tmp_path)
    config = twin_file(tmp_path, 'store = "sqlite:///twin.db"')
    first, copy = tmp_path / "first", tmp_path / "copy"
    first.mkdir()
    with service(config) as url:
        (first / "edge.toml").write_text(EDGE.format(url=url))
        (first / "token").touch(0o600)
        (first / "token").write_text(TOKEN)
        with edge(first, "b1-aa") as one:
            one.send()
            until(lambda: stored() == {("b1-aa", 0)})
            until(lambda: (first / "status.json").exists())
            shutil.copytree(first, copy, ignore=shutil.ignore_patterns("*.new"))  # a file that is being replaced
            with edge(copy, "b2-bb") as two:
                two.send()
                until(lambda: ("b2-bb", 0) in stored())
                one.send()
                until(one.heard)
                until(lambda: one.status.get("conflict") is True and one.status["windows"]["waiting"] == 1)
                two.send()
                until(lambda: ("b2-bb", 1) in stored())
                assert two.status["conflict"] is False
                alarm = "SELECT status FROM evidence WHERE kind = 'alarm'"
                until(lambda: bool(asked(alarm)))
                assert asked(alarm) == [
                    ("conflict: two edges of this servo run, b1-aa and b2-bb; the newer one counts",)
                ]
        assert stored() == {("b1-aa", 0), ("b2-bb", 0), ("b2-bb", 1)}
        with edge(first, "b3-cc") as again:  # an operator starts the right one again: what waited is not lost
            until(lambda: ("b1-aa", 1) in stored())
            until(lambda: again.status.get("conflict") is not True)  # until then that of the edge before
            # It knows nothing of the copy that ran after it, and what may wait there: both sides say so, once.
            until(lambda: again.status["disk"]["faults"].get("folder behind") == 1)
            [_, (behind,)] = asked(alarm)
            assert "b3-cc began in a folder that knows nothing of the run b2-bb" in behind
        with edge(first, "b4-dd") as last:
            last.send()
            until(lambda: ("b4-dd", 0) in stored())
            assert len(asked(alarm)) == 2


@pytest.mark.slow
def test_of_a_computer_that_was_cloned_while_its_edge_ran_neither_copy_counts_and_all_say_so(tmp_path: Path) -> None:
    """Same run, same claim, same numbers: only the windows differ. No window but the first to differ is lost."""

    asked, stored = partial(query, tmp_path), partial(stored_windows, tmp_path)
    config = twin_file(tmp_path, 'store = "sqlite:///twin.db"')
    first, clone = tmp_path / "first", tmp_path / "clone"
    first.mkdir()
    with service(config) as url:
        (first / "edge.toml").write_text(EDGE.format(url=url))
        (first / "token").touch(0o600)
        (first / "token").write_text(TOKEN)
        with edge(first, "b1-aa") as one:
            one.send()
            until(lambda: stored() == {("b1-aa", 0)})
            until(lambda: (first / "status.json").exists())
            shutil.copytree(first, clone, ignore=shutil.ignore_patterns("*.new"))
            with edge(clone, "b1-aa") as two:
                two.sent = 1
                for number in (1, 2):
                    one.send()
                    until(lambda number=number: ("b1-aa", number) in stored())
                    two.send(samples=12)
                until(one.heard)
                until(two.heard)
                one.send()
                two.send(samples=12)
                until(lambda: one.status.get("conflict") is True and one.status["windows"]["waiting"] == 1)
                until(lambda: two.status.get("conflict") is True and two.status["windows"]["waiting"] == 2)
                assert two.status["windows"]["dropped"] == {"conflict": 1}
        assert stored() == {("b1-aa", 0), ("b1-aa", 1), ("b1-aa", 2)}
        first_word, last_word = (text for (text,) in asked("SELECT status FROM evidence WHERE kind = 'alarm'"))
        assert first_word == "conflict: another window came under the name b1-aa/1 of a stored one"
        assert "two copies of the run b1-aa send" in last_word
        with edge(first, "b2-bb") as again:  # an operator starts the right one again
            again.send()
            until(lambda: stored() >= {("b1-aa", 3), ("b2-bb", 0)})
            until(lambda: again.status.get("conflict") is not True)
            assert not again.status["disk"]["faults"].get("folder behind")
        assert len(asked("SELECT 1 FROM evidence WHERE kind = 'alarm'")) == 2
