"""The axis presets with their twins in the loop, as they are measured, and a short loop of each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.axis_presets import judged, measured
from benchmarks.preset_machines import DUTIES, certified_machines, growing_machines, preset_machines
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.plant.axis import AXES

ESTIMATED = tuple(name for name in DUTIES if name != "emps")


@pytest.mark.slow
def test_every_preset_has_a_duty_and_machines_near_it() -> None:
    assert tuple(DUTIES) == AXES
    for name in DUTIES:
        machines = preset_machines(name, 3, 5)
        assert machines == preset_machines(name, 4, 5)[:3]
        assert machines[0].gap.value(machines[0].duration) == pytest.approx(
            10.0 * DUTIES[name].gap / machines[0].model.p
        )
        assert growing_machines(name, 3, 5) == [replace(each, certified=True) for each in machines]
        worn = certified_machines(name, 3, 5)
        assert [each.plant for each in worn] == [each.plant for each in machines]
        # A stepper goes where it is told, and its load follows: of the numbers that are off only its lead shows.
        assert (machines[0].plant.p == machines[0].model.p) == (name != "stepper-stage")
        assert machines[0].plant != machines[0].model
        assert all(each.certified and 0.0 < each.worn[0] == each.worn[1] < 10.0 for each in worn)


@pytest.mark.slow
@pytest.mark.parametrize("name", DUTIES)
def test_no_window_between_two_levels_sees_the_gap_move(name: str) -> None:
    """Windows longer than a half period overlap; one in `hold` of them may see a move."""
    (machine,), duty = preset_machines(name, 1, 5), DUTIES[name]
    starts = np.maximum(np.arange(duty.hold > 1, machine.steps) - duty.before, 0.0) * duty.half_period
    moving = [machine.gap.constant_between(start, start + duty.window * duty.half_period) is None for start in starts]
    assert sum(moving) <= (0 if duty.hold == 1 else machine.steps / duty.hold)
    levels = {round(float(machine.gap.value(start) / machine.gap.value(machine.duration)), 9) for start in starts}
    assert {0.0, 1.0} <= levels


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("ball-screw", 2),
        *(pytest.param(n, 3, marks=pytest.mark.exploration) for n in ESTIMATED if n != "stepper-stage"),
    ],
)
def test_a_preset_s_twin_finds_its_gap(name: str, steps: int) -> None:
    """Steps of a machine that is not quite its model, worn to five times its healthy gap."""
    (machine,) = preset_machines(name, 1, 20261123)
    found = measured(replace(machine, worn=(5.0, 5.0), steps=steps))
    accepted = found["estimates"]
    assert "ok" in found["statuses"], found["reasons"]
    assert all(each["near"] and each["inside"] for each in accepted), accepted


@pytest.mark.slow
def test_steps_of_a_stepper_between_two_places_do_not_tell_gap_from_ratio() -> None:
    """They leave a gap possible that is off by more than is accepted, for another ratio and delay."""
    (machine,) = preset_machines("stepper-stage", 1, 20261123)
    found = measured(replace(machine, worn=(5.0, 5.0), steps=2))
    assert found["statuses"] == ["unidentifiable"]
    assert "the gap is known to" in found["reasons"][0]


def test_a_preset_without_a_load_encoder_is_refused() -> None:
    (machine,) = preset_machines("emps", 1, 20261123)
    for certified in (False, True):
        found = measured(replace(machine, steps=2, certified=certified))
        assert "twin" not in found
        assert "own" in found
        assert found["refused"]


def test_an_estimate_is_judged_by_gap_interval_and_counts() -> None:
    def at(gap: float, half: float) -> dict[str, float]:
        estimate = GapEstimate(gap, 0.1 * half, half, (gap - half, gap + half), GapStatus.OK, 1.0)
        return judged(estimate, (0.9, 1.0, 1.1), 1e-3)

    assert at(1.0, 0.1) == {"gap": 1.0, "error": 0.0, "inside": 1.0, "near": 1.0, "steady": 0.0}
    assert at(1.109, 0.05)["near"] == 1.0
    assert at(1.109, 0.05)["inside"] == 0.0
    assert at(0.5, 0.1)["near"] == 0.0
    assert math.isclose(at(0.5, 0.1)["error"], 0.4)
