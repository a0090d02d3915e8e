"""Verified settings of the presets on fresh machines: the numbers of a question, and their table."""

from __future__ import annotations

import pytest
from rich.console import Console

from benchmarks.axis_certificates import BATCH, questions
from benchmarks.preset_machines import DUTIES


@pytest.mark.slow
def test_a_verified_setting_settles_beside_the_own_controller() -> None:
    units = dict(BATCH.units(("stepper-stage", "emps"), 20, 5))
    assert list(units) == [f"5/{name}/{question}" for name in ("stepper-stage", "emps") for question in questions(name)]
    found = {key: BATCH.measure(task) for key, task in units.items() if key.endswith("any gap")}
    stepper, published = found.values()
    assert stepper["setting"]["settled"] == stepper["count"] == stepper["own"]["settled"] == 20
    assert stepper["Ms"] < 2.2
    assert "the feedback must be" in published["refused"]
    console = Console(width=200, record=True)
    BATCH.show(found, console)
    text = console.export_text()
    assert "stepper-stage" in text
    assert "emps, any gap: sensors.feedback" in text


def test_questions_are_about_the_ranges_of_the_loops() -> None:
    for name, duty in DUTIES.items():
        whole, known = questions(name).values()
        assert whole.gap[0] == 0.0
        assert known.gap[1] == pytest.approx(whole.gap[1] * 5.05 / 15.0)
        assert whole.step == known.step == (30.0 * duty.gap, 200.0 * duty.gap)
