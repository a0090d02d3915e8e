"""The generator of foreign logs: every format is read back, and a case is measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.log_files import WRITERS, damaged
from benchmarks.logs import inside, log_cases, measured
from benchmarks.preset_machines import DUTIES
from servotwin.logs.recordings import read_recording

_TIME = np.arange(400) * 0.01
TABLE = np.column_stack([_TIME, np.sin(_TIME), 0.1 * np.sin(_TIME) + 3.0])


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_is_read_back(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    log = read_recording(path, WRITERS[name](path, TABLE))
    assert (log.recording.motor_unit, log.recording.load_unit) == ("rad", "m")
    assert np.allclose(log.recording.time - log.recording.time[0], TABLE[:, 0], atol=2e-6)
    assert np.allclose(log.recording.motor, TABLE[:, 1], atol=1e-9)
    assert np.allclose(log.recording.load, TABLE[:, 2], atol=1e-9)


def test_every_defect_is_put_in_sooner_or_later() -> None:
    found = {name for seed in range(30) for name in damaged(TABLE, np.random.default_rng(seed), wrapped=True)[1]}
    assert found == {
        *("wrapped", "jitter", "held", "events", "dropouts", "spikes", "no numbers", "duplicates", "disorder", "stale")
    }


@pytest.mark.slow
def test_a_case_is_the_same_however_many_are_drawn_and_is_answered() -> None:
    two, three = ([each.gap for each in log_cases("telescope", count, 7)] for count in (2, 3))
    assert two == three[:2]
    assert all(each.gap > 0.0 and each.speed > 0.0 for name in DUTIES for each in log_cases(name, 3, 7))
    case = replace(log_cases("stepper-stage", 1, 101)[0], file="arrays.npz")
    numbers = measured(case)
    assert numbers["status"] == "lost motion"
    assert inside(numbers["interval"], numbers["gap"], numbers["lost"])


def test_an_interval_contains_a_gap_or_some_gap_of_a_range() -> None:
    assert inside([1.0, 2.0], 1.5)
    assert not inside([1.0, 2.0], 2.5)
    assert inside([1.0, 2.0], 0.5, 1.5)
    assert inside([None, None], 9.0)
