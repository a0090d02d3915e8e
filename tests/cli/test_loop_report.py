"""What `servotwin simulate` says of a loop: estimates beside the true gap, settings, ends of the steps."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress, TaskID

import servotwin as st
from servotwin.cli import simulate
from servotwin.cli.loop_report import reasons, step_ends, summary, window_table
from servotwin.cli.simulate import record
from servotwin.cosim import Loop
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.redesign.policy import Redesign

SCENARIO = """
servo = "paper"
name = "worn"
duration_s = 60.0
reference = { kind = "square", amplitude_mm = 1.0, period_s = 40.0 }
gap = { from_deg = 8.0, to_deg = 9.0, over_s = 60.0 }
[controller]
ki_v_per_m_s = 0.0
[twin]
policy = "paper"
k_dz = 0.0
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "worn.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def loop(file: Path) -> Loop:
    return st.cosimulate(st.Scenario.load(file))


def told(loop: Loop) -> str:
    console = Console(record=True, width=200)
    for line in summary(loop):
        console.print(line, markup=False, highlight=False)
    console.print(window_table(loop))
    return console.export_text()


def test_the_ends_of_the_steps_are_those_of_the_signals(loop: Loop) -> None:
    run = loop.run
    ends = step_ends(run)
    changes = np.flatnonzero(np.diff(run.reference)) + 1
    assert len(ends) == 3 == changes.size + (run.reference[0] != 0.0) - (changes[-1] > 0.9 * run.time.size)
    last = run.time > 0.9 * 20.0
    first = np.abs(run.reference - run.position)[last & (run.time < run.time[changes[0]])]
    assert ends[0].error == first.max()
    assert (ends[0].size, ends[1].size) == (pytest.approx(1e-3), pytest.approx(2e-3))
    assert [each.rests for each in ends] == [each.error <= 0.01 * each.size for each in ends]


def test_a_reference_that_does_not_step_has_no_ends() -> None:
    servo = st.Servo.preset("paper")
    slope = np.linspace(0.0, 1e-3, 2001)
    reference = st.Samples(np.linspace(0.0, 1.0, 2001), list(slope))
    assert step_ends(st.simulate(servo, 1.0, reference=reference, gap=0.1, sample_rate=2000.0)) == []


def test_the_report_says_what_the_twin_found(loop: Loop) -> None:
    text = told(loop)
    accepted = [each for each in loop.estimates if each.ok]
    assert f"worn: 60 s, {len(loop.windows)} windows reached the twin" in text
    assert f"gap: {len(accepted)} of {len(loop.estimates)} windows accepted, off by at most" in text
    for status in {each.status for each in loop.estimates} - {GapStatus.OK}:
        assert str(status) in text
    assert "steps: " in text
    assert " um in the median" in text
    truth = np.degrees(np.interp(accepted[0].time, loop.run.time, loop.run.gap))
    assert f"{truth:.4g}" in text


def test_where_no_window_tells_both_flanks_longer_ones_are_named(loop: Loop) -> None:
    assert "[twin.excitation]" not in told(loop)
    unseen = [replace(each, status=GapStatus.UNIDENTIFIABLE, reasons=("one flank",)) for each in loop.estimates]
    assert "no window of 2 s tells both flanks: record longer ones, best with a move each way" in told(
        replace(loop, estimates=tuple(unseen))
    )


def test_a_window_takes_one_line_of_a_terminal(loop: Loop) -> None:
    worst = [replace(each, status=GapStatus.MODEL_MISMATCH, interval=(0.01234, 0.12345)) for each in loop.estimates]
    sent = [replace(each, reason="the fallback set is sent", setting=loop.updates[0]) for each in loop.redesigns]
    console = Console(record=True, width=80)
    console.print(window_table(replace(loop, estimates=tuple(worst), redesigns=tuple(sent))))
    assert len(console.export_text().splitlines()) == 1 + len(worst)


def test_every_window_without_a_setting_has_a_reason(loop: Loop) -> None:
    assert list(reasons(loop)) == []
    first, *others = loop.redesigns
    kept = [Redesign(None, math.nan, "in force already")] * len(others)
    found = list(reasons(replace(loop, redesigns=(replace(first, reason="the fallback set is sent"), *kept))))
    times = [each.time for each in loop.estimates]
    more = f" and {len(others) - 1} more, the first" if len(others) > 1 else ""
    assert found == [f"  {times[0]:.4g} s: the fallback set is sent", f"  {times[1]:.4g} s{more}: in force already"]


def test_reasons_that_differ_by_their_numbers_only_are_one(loop: Loop) -> None:
    grows = [replace(each, reason=f"may grow to {1.5 + n} deg") for n, each in enumerate(loop.redesigns)]
    (line,) = reasons(replace(loop, redesigns=tuple(grows)))
    assert line.endswith(f"s and {len(grows) - 1} more, the first: may grow to 1.5 deg")


@pytest.mark.slow
def test_simulate_shows_the_report_and_writes_what_is_asked_for(file: Path, tmp_path: Path) -> None:
    console = Console(record=True, width=200)
    assert record(file, console=console, figure=tmp_path / "run.png", windows=True) is None
    text = console.export_text()
    assert "worn: 60 s" in text
    assert "95 % interval, deg" in text
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert [each.name for each in tmp_path.iterdir()] == ["run.png"]


def test_progress_names_the_search_and_goes_to_the_standard_error(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fallback set that no process has found yet is searched for while the scenario is read."""
    shown: list[tuple[str, bool]] = []

    class Shown(Progress):
        def add_task(self, description: str, *options: Any, **named: Any) -> TaskID:
            shown.append((description, self.console.stderr))
            return super().add_task(description, *options, **named)

        def update(self, task_id: TaskID, **changes: Any) -> None:
            super().update(task_id, **changes)
            shown.append((self.tasks[task_id].description, self.console.stderr))

    def read(path: Path) -> tuple[str, st.Scenario]:
        assert shown == [("looking for a verified fallback set", True)]
        return "", st.Scenario.load(path)

    monkeypatch.setattr(simulate, "Progress", Shown)
    monkeypatch.setattr(simulate, "read_scenario", read)
    record(file)
    assert shown[-1] == ("simulating", True)


@pytest.mark.parametrize("name", ["run.pdf", "missing/run.png"])
def test_a_figure_that_cannot_be_written_is_refused_before_the_run(file: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInput, match=name.rpartition("/")[0] or r"\.png, \.svg"):
        record(file, figure=tmp_path / name)
