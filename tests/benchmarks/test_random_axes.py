"""Random axes: each is drawn from its place alone, can be simulated, and its estimates are judged."""

from __future__ import annotations

import math

import pytest
from rich.console import Console

from benchmarks import random_axes
from benchmarks.random_axes import BATCHES, NAME, WINDOWS, random_axis, step_window
from servotwin.estimation.output_error import least_rate

BATCH = BATCHES[NAME]


@pytest.mark.slow
def test_an_axis_depends_on_its_place_alone_and_has_enough_samples_of_a_swing() -> None:
    for block in BATCH.blocks:
        one, other = random_axis(block, 5, 0), random_axis(block, 5, 1)
        assert one == random_axis(block, 5, 0)
        assert one.model != other.model
        for each in (one, other):
            assert (each.model.controller.sample_rate or 0.0) > least_rate(each.model)
            assert 0.0 < each.gap * each.model.p <= 0.25 * each.amplitude * (1.0 + 1e-12)
            assert each.plant != each.model


@pytest.mark.slow
def test_estimates_are_judged_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(random_axes, "_STEPS", 2)
    (key, task), *_ = BATCH.units(("velocity",), 1, 8)
    numbers = BATCH.measure(task)
    assert numbers["windows"] == len(numbers["estimates"]) == 2
    assert all(math.isfinite(each["error"]) for each in numbers["estimates"])
    wrong = {"windows": 8, "estimates": [{"near": 0.0, "inside": 0.0, "error": 0.1, "gap": 0.1, "steady": 1.0}]}
    console = Console(width=120, record=True)
    BATCH.show({key: numbers, "8/torque/1": wrong, "8/velocity/1": {"refused": "no"}}, console)
    text = console.export_text()
    assert "8/torque/1: 1 false" in text
    assert text.count("8/") == 1


@pytest.mark.slow
def test_windows_without_a_twin_are_estimated() -> None:
    numbers = BATCHES[WINDOWS].measure(next(task for _, task in BATCH.units(("velocity",), 1, 8)))
    assert numbers["windows"] == len(numbers["estimates"]) == 3
    assert all(estimate["near"] for estimate in numbers["estimates"])
    drawn = random_axis("velocity", 8, 0)
    assert step_window(drawn, 2).start == pytest.approx(1.95 * drawn.half_period, rel=1e-3)
