"""`servotwin bench tick` measures the real loop; nothing of what it imports is a numbers library."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import tick
from benchmarks.tickloop import PacedDrive
from servotwin.edge_process.monitoring import BINS, TickHistogram, summarise


@pytest.mark.slow
def test_a_run_counts_every_instant_as_a_sample_or_as_missed() -> None:
    run = tick.measured((1000.0, True, False), 2.5)
    assert run["wake"]["number"] + run["missed"] >= 2500
    assert run["answer"]["number"] == run["whole"]["number"]
    assert run["windows"] == 2
    assert 0 < run["answer"]["median_us"] <= run["whole"]["median_us"]
    assert (run["pack_s"] > 0.0, run["put_s"] > 0.0, run["realtime"]) == (True, True, False)
    console = Console(record=True, width=140)
    console.print(tick.shown([run]))
    assert "normal" in console.export_text()
    assert "PREEMPT_RT" in " ".join(tick.summary_lines([run]))


def test_the_loop_imports_no_numbers_library() -> None:
    code = "import sys, benchmarks.tickloop; print(sorted({'numpy', 'scipy', 'numba', 'rich'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"


def test_the_document_holds_every_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = {name: summarise(TickHistogram().dumps(), 0.0) for name in ("wake", "answer", "whole")}
    fake = {"overruns": 0, "missed": 0, "windows": 1, "pack_s": 1e-3, "put_s": 1e-3, "load": 0.5, **times}
    monkeypatch.setattr(tick, "measured", lambda case, _: {"rate_hz": case[0], "realtime": case[2], **fake})
    tick.ticks("today", tmp_path / "tick.json", console=Console(quiet=True))
    document = json.loads((tmp_path / "tick.json").read_text())
    assert (document["schema"], len(document["runs"])) == ("servotwin-bench-tick/1", 8)


def test_a_missed_instant_is_a_missing_number(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("benchmarks.tickloop.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("benchmarks.tickloop.time.sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    drive = PacedDrive(100.0, 1.0, False)
    drive.connect()
    first = drive.read()
    now[0] += 0.035
    second = drive.read()
    assert first is not None
    assert second is not None
    assert (first.number, second.number, drive.missed, drive.overruns) == (0, 3, 2, 1)


def test_a_time_beyond_the_bins_is_reported_as_the_longest() -> None:
    counts = TickHistogram()
    for _ in range(10):
        counts.add(2 * BINS * 1e-6)
    assert summarise(counts.dumps(), counts.longest)["median_us"] == pytest.approx(2 * BINS)
