"""Failures that cost neither the control loop nor a window: disk, window filter, log, drive, an old file."""

import math
import os
import sys
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.edge.drive import DriveLost
from servotwin.edge.guard import Limits
from servotwin.edge.outlet import CHANNELS, NOT_ADOPTED, UNFILTERED
from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Cut
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process import frame_handler, frames, monitoring
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.edge_process.frame_handler import FrameHandler
from servotwin.edge_process.monitoring import TickHistogram
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.run import StopSignal, run_role
from servotwin.edge_process.startup import permitted
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import LearntResponse, Setting, encode

LAW = Controller(200.0, 0.0, 0.0, 0.1, sample_rate=100.0)
SETTINGS = AgentSettings("axis-1", UNBOOTED, 100.0, 0.1, limits=Limits(maximum=1e-3), controller=LAW)
CONFIG = EdgeConfig(SETTINGS, "control", LAW, {"kind": "simulated"})


class FailingFilter:
    longest_pause_s, response_version = math.inf, 0

    def check(self, sample_rate: float) -> None:
        """Any rate will do."""

    def start(self, _saved: bytes | None = None) -> "FailingFilter":
        return self

    def __call__(self, _cut: Cut) -> Cut | None:
        raise ZeroDivisionError

    def adopt(self, _response: LearntResponse) -> None:
        raise ZeroDivisionError

    def dumps(self) -> bytes:
        return b""


def cut(sequence: int, position: float = 1e-3) -> frames.WindowFrame:
    signals = {name: array("d", [0.0, position]) for name in CHANNELS}
    return frames.window_frame(Cut(7, sequence, "reference", 3, 0.0, signals), "b1", 10 + sequence)


@pytest.fixture
def outbox(tmp_path: Path) -> Iterator[SqliteOutbox]:
    """Its folder is not there yet."""
    box = SqliteOutbox(tmp_path / "disk" / "outbox.sqlite", "axis-1")
    yield box
    box.close()


@pytest.fixture
def handler(outbox: SqliteOutbox, tmp_path: Path) -> FrameHandler:
    return FrameHandler(replace(CONFIG, folder=tmp_path), outbox)


def test_an_unwritten_window_is_not_confirmed(handler: FrameHandler, tmp_path: Path) -> None:
    assert handler.handle(cut(0)) == []
    assert handler.handle(frames.LetterFrame(20, b"letter")) == []
    assert handler.retry() == []
    (tmp_path / "disk").mkdir()
    assert handler.retry() == [10, 20]
    assert handler.handle(cut(1)) == [11]


def test_a_window_that_the_twin_has_is_confirmed_without_the_disk(handler: FrameHandler, outbox: SqliteOutbox) -> None:
    handler.handle(cut(0))
    handler.handle(cut(1))
    outbox.remove(("b1", 0))
    assert handler.retry() == [10]


def test_unwritten_frames_are_bounded(handler: FrameHandler, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_handler, "MOST_UNWRITTEN", 3 * 64)
    assert [handler.handle(cut(k)) for k in range(5)] == [[], [], [], [10], [11]]


def test_a_window_whose_filter_fails_is_sent(
    handler: FrameHandler, outbox: SqliteOutbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handler, "_config", replace(CONFIG, agent=replace(SETTINGS, window_filter=FailingFilter())))
    handler.handle(cut(0))
    assert outbox.pending() == [("b1", 0)]
    assert handler.faults == {UNFILTERED: 1}


def test_windows_whose_filter_cannot_start_are_sent(
    handler: FrameHandler, outbox: SqliteOutbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_filter: FailingFilter, _saved: bytes | None = None) -> FailingFilter:
        raise PermissionError(13, "cannot allocate executable memory")  # numba's, under MemoryDenyWriteExecute

    monkeypatch.setattr(FailingFilter, "start", start)
    monkeypatch.setattr(handler, "_config", replace(CONFIG, agent=replace(SETTINGS, window_filter=FailingFilter())))
    handler.handle(cut(0))
    handler.handle(cut(1))
    assert outbox.pending() == [("b1", 0), ("b1", 1)]
    assert handler.faults == {UNFILTERED: 2}


def test_a_response_at_which_the_filter_fails_is_counted(
    handler: FrameHandler, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handler, "_config", replace(CONFIG, agent=replace(SETTINGS, window_filter=FailingFilter())))
    response = LearntResponse("axis-1", 1, 100.0, ((0.5, 0.1, 1e-4, 0.0),), 0.0, 3e-4, 0.0, 0.1, 1e-4)
    handler.handle(frames.ResponseFrame(1, "b1", encode(response)))
    assert handler.faults == {NOT_ADOPTED: 1}


def test_a_window_with_a_bad_sample_is_not_filtered_and_not_sent(
    handler: FrameHandler, outbox: SqliteOutbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handler, "_config", replace(CONFIG, agent=replace(SETTINGS, window_filter=FailingFilter())))
    handler.handle(cut(0, math.nan))
    assert outbox.pending() == []
    assert outbox.dropped == {"sample not finite": 1}
    assert not handler.faults


def test_an_acknowledged_frame_ends_the_wait_for_the_twin() -> None:
    """The window was delivered before its link process died: the next one only acknowledges the frame."""
    box = PipeOutlet(True)
    box.offer(cut(0).cut)
    assert box.unacknowledged
    received = box._receive([frames.encode(frames.AckFrame(1))])
    assert received.pending_changed
    assert not box.unacknowledged


def test_logging_to_a_full_pipe_does_not_block(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as out, os.fdopen(writer, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        for k in range(2000):
            monitoring.log("event", number=k)
        os.set_blocking(out.fileno(), False)
        assert out.read().startswith(b'{"time":')
        monkeypatch.undo()


def test_without_a_standard_error_nothing_is_logged(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monitoring.log("heard")
    with monkeypatch.context() as context:
        context.setattr(sys, "stderr", None)
        monitoring.log("unheard")
    out, logged = capfd.readouterr()
    assert out == ""
    assert "heard" in logged
    assert "unheard" not in logged


class Failing:
    """A role that ends by an error."""

    def __init__(self, error: Exception) -> None:
        self.error, self.stopped = error, 0

    def step(self) -> bool:
        raise self.error

    def lost(self) -> None:
        """Nothing."""

    def stop(self) -> None:
        self.stopped += 1
        raise DriveLost("gone too")


@pytest.mark.parametrize(("error", "stopped"), [(RuntimeError("a bug"), 1), (DriveLost("gone"), 0)])
def test_an_error_in_the_loop_leaves_the_drive_safe(error: Exception, stopped: int) -> None:
    role = Failing(error)
    with pytest.raises(type(error), match=str(error)):
        run_role(StopSignal(), role)
    assert role.stopped == stopped


def test_stored_parameters_hold_where_todays_limits_allow_them() -> None:
    gains = gains_of(LAW)
    good = Parameters(3, Setting(1e-3, gains))
    assert permitted(good, SETTINGS) is good
    assert permitted(None, SETTINGS) is None
    assert permitted(replace(good, setting=Setting(1.1e-3)), SETTINGS) is None
    assert permitted(good, replace(SETTINGS, limits=Limits(maximum=1e-4))) is None
    assert permitted(good, replace(SETTINGS, controller=None)) is None
    assert permitted(good, replace(SETTINGS, controller=LAW.replace(Kp=20.0))) is None
    fallback = Parameters(4, Setting(2e-3), fallback=True)
    assert permitted(fallback, SETTINGS) is fallback


def test_ticks_are_counted_for_years() -> None:
    counts = TickHistogram()
    counts.bins[30] = 2**40
    counts.add(30.5e-6)
    assert counts.bins[30] == 2**40 + 1
    assert counts.bins.itemsize == 8
