"""Frame handler of the link process, without processes; boot names, tick histogram, log of troubles."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from edge_process_parts import CONFIG, cut
from hypothesis import given
from hypothesis import strategies as st

from servotwin.edge.parameters import Parameters
from servotwin.edge.store import FileParameterStore, StoredParameters
from servotwin.edge_process import frames
from servotwin.edge_process.frame_handler import FrameHandler
from servotwin.edge_process.monitoring import (
    TickHistogram,
    TroubleLog,
    overwrite_status,
    read_status,
    summarise,
    write_status,
)
from servotwin.edge_process.startup import count_start, next_boot, stored_parameters
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import Setting


@pytest.fixture
def handler(tmp_path: Path) -> Iterator[FrameHandler]:
    outbox = SqliteOutbox(tmp_path / "outbox.sqlite", "axis-1")
    yield FrameHandler(replace(CONFIG, folder=tmp_path), outbox)
    outbox.close()


def test_a_repeated_cut_is_stored_and_counted_once(handler: FrameHandler, tmp_path: Path) -> None:
    bad = cut(1)
    bad.signals["position"][3] = math.nan
    for serial, each in enumerate([cut(0), bad, cut(0), bad, cut(2)], 1):
        assert handler.handle(frames.window_frame(each, "b1", serial)) == [serial]
    outbox = handler._outbox
    assert outbox.pending() == [("b1", 0), ("b1", 2)]
    assert outbox.dropped == {"sample not finite": 1}
    assert outbox.get(("b1", 0)).boot == "b1"


def test_parameters_are_written_or_tried_again(handler: FrameHandler, tmp_path: Path) -> None:
    store = FileParameterStore(tmp_path / "parameters.json")
    (tmp_path / "parameters.json.new").mkdir()
    assert handler.handle(frames.SaveFrame(1, StoredParameters.of(Parameters(1, Setting(1e-4))))) == []
    assert handler.handle(frames.SaveFrame(2, StoredParameters.of(Parameters(2, Setting(2e-4))))) == [1]
    assert handler.faults["parameters not written"] == 2
    (tmp_path / "parameters.json.new").rmdir()
    assert handler.retry() == [2]
    assert handler.retry() == []
    found = store.load()
    assert found is not None
    assert found.version == 2


def test_the_cursor_only_rises(handler: FrameHandler) -> None:
    for serial in (3, 7, 5):
        handler.handle(frames.ProcessedFrame(serial))
    assert handler._outbox.number("cursor") == 7


def test_the_count_of_boots_is_its_owner_s_alone(tmp_path: Path) -> None:
    count_start(tmp_path / "boots", "b1-00")
    assert (tmp_path / "boots").stat().st_mode & 0o777 == 0o600


def test_boot_names_are_unique_whatever_becomes_of_the_count(tmp_path: Path) -> None:
    file = tmp_path / "boots"
    for k in range(3):
        boot = next_boot(file, bytes([k]))
        assert boot == f"b{k + 1}-0{k}"
        count_start(file, boot)
    assert next_boot(file, b"\x05") == "b4-05"
    assert next_boot(file, b"\x06") == "b4-06", "the one before was not counted"
    count_start(file, "b1-00")
    assert next_boot(file, b"\x07") == "b4-07", "the count does not fall"
    file.write_text("rubbish")
    assert next_boot(file, b"\x08") == "b1-08"
    count_start(tmp_path / "absent" / "boots", "b1-09")
    assert next_boot(tmp_path / "absent" / "boots", b"\x0a") == "b1-0a"


def test_last_parameters_that_cannot_be_read_do_not_stop_the_machine(tmp_path: Path) -> None:
    file = tmp_path / "parameters.json"
    assert stored_parameters(file) is None
    FileParameterStore(file).save(Parameters(4, Setting(1e-4)))
    found = stored_parameters(file)
    assert found is not None
    assert found.version == 4
    for rubbish in ("rubbish", "[" * 100_000):
        file.write_text(rubbish)
        assert stored_parameters(file) is None
        assert (tmp_path / "parameters.json.broken").read_text() == rubbish


@given(st.lists(st.floats(0.0, 2e-3), min_size=1, max_size=300))
def test_counted_durations_give_quantiles_to_a_microsecond(durations: list[float]) -> None:
    counts = TickHistogram()
    for each in durations:
        counts.add(each)
    found = summarise(counts.dumps(), counts.longest)
    ordered = sorted(durations)
    for name, share in (("median_us", 0.5), ("p99_us", 0.99)):
        exact = ordered[max(0, math.ceil(share * len(ordered)) - 1)] * 1e6
        assert found[name] == pytest.approx(exact, abs=1.001)
    assert found["number"] == len(durations)
    assert found["max_us"] == pytest.approx(ordered[-1] * 1e6, abs=0.06)


def test_a_trouble_is_logged_when_it_begins_changes_and_ends(capfd: pytest.CaptureFixture[str]):
    troubles = TroubleLog()
    for why in ("", "", "refused", "refused", "away", "", ""):
        troubles.update("to the twin", why)
    troubles.update("disk", "")
    lines = [msgspec.json.decode(line) for line in capfd.readouterr().err.splitlines()]
    assert [(line["event"], line["where"], line.get("why")) for line in lines] == [
        ("trouble", "to the twin", "refused"), ("trouble", "to the twin", "away"), ("trouble over", "to the twin", None)
    ]  # fmt: skip


def test_a_status_that_cannot_be_replaced_is_written_over_the_old_one(tmp_path: Path) -> None:
    """As on a full disk, where a new file finds no room: the old one must not go on saying that all is safe."""
    file = tmp_path / "status.json"
    write_status(file, {"servo": "axis-1", "disk": {"safe": True}, "written": 1.0, "more": "x" * 300})
    assert file.stat().st_mode & 0o777 == 0o600
    size = file.stat().st_size
    for length in (10, 10_000):  # the second is longer than the file: only what matters is written
        status = {"servo": "axis-1", "disk": {"safe": False}, "written": 2.0, "more": "x" * length}
        overwrite_status(file, status)
        found = read_status(file)
        assert found is not None
        assert (found["disk"], found["written"]) == ({"safe": False}, 2.0)
        assert file.stat().st_size == size
    file.write_text("{}")
    with pytest.raises(OSError, match="longer than its file"):
        overwrite_status(file, {"servo": "axis-1"})
