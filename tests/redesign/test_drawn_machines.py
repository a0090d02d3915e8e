"""Machines drawn for a verification, and steps up and down where a bias or a force pushes one way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import confirm
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw, draw_independently, drawn_plants
from servotwin.redesign.certified.policy import band_of
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

DEG = math.pi / 180.0
SERVO = Servo.preset("paper").replace(sample_rate=500.0, voltage_limit=2.0)
BIAS, FRICTION = -0.08, 0.06  # V, of the motor at rest
CALM = SERVO.controller.replace(Ki=0.0, Kp=500.0, Kd=-55.0, feedforward=-BIAS, friction_feedforward=FRICTION)
SETTING = Design(CALM, 0.0)
KNOWN = Uncertainty(
    gap=(9.9 * DEG, 10.1 * DEG),
    input_bias=(BIAS - 0.001, BIAS + 0.001),
    friction=(0.95 * SERVO.torque_of(FRICTION), 1.05 * SERVO.torque_of(FRICTION)),
)
TRIAL = Trial(20.0, 4.0, 50.0)


# --- ranges


def test_machines_fill_their_ranges_and_hold_the_corners() -> None:
    known = Uncertainty(gap=(2.0 * DEG, 8.0 * DEG), input_bias=(-0.1, 0.3), friction=(0.0, 1e-3))
    members = draw(SERVO, known, 16, 8)
    assert members.plants[0] == SERVO
    assert members.count == 128
    for values, (low, high) in (
        (members.gap, known.gap),
        (members.step, known.step),
        (members.input_bias, known.input_bias),
        (members.friction, known.friction),
    ):
        assert low - 1e-12 <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high + 1e-12
    assert np.all(members.gap[:, 0] == known.gap[1])
    assert np.all(members.input_bias[:, 1] == known.input_bias[0])
    assert np.all(np.abs(members.theta_d0) <= 0.5 * members.gap)


def test_plants_stay_within_the_stated_widths() -> None:
    plants = drawn_plants(SERVO, Uncertainty(k=0.1, c=0.5, k_B=0.0, m=0.02), 64, 3)
    ratios = np.array([[p.k / SERVO.k, p.c / SERVO.c, p.k_B / SERVO.k_B, p.m / SERVO.m] for p in plants])
    assert np.all(np.abs(ratios - 1.0) <= [0.1, 0.5, 1e-15, 0.02])
    assert np.all(np.abs(ratios - 1.0).max(axis=0)[[0, 1, 3]] > [0.08, 0.4, 0.016])


def test_equal_calls_draw_equal_machines() -> None:
    first, second = (draw(SERVO, Uncertainty(), 8, 4, seed=5) for _ in range(2))
    assert np.array_equal(first.gap, second.gap)
    assert first.plants == second.plants
    assert not np.array_equal(first.gap, draw(SERVO, Uncertainty(), 8, 4, seed=6).gap)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"k": 1.0}, "uncertainty k = 1.0"),
        ({"gap": (2.0, 1.0)}, "uncertainty gap = \\(2.0, 1.0\\) rad"),
        ({"step": (0.0, 1e-3)}, "must be two numbers, each a positive number"),
        ({"input_bias": (0.0, math.inf)}, "input_bias = \\(0.0, inf\\) V"),
        ({"friction": (-1e-3, 0.0)}, "must be two numbers, each a number, at least 0"),
    ],
)
def test_wrong_ranges_are_named(changes: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        Uncertainty(**changes)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="no value named 'kk'"):
        Uncertainty().replace(kk=0.1)


# --- directions


def voltage_held(direction: float) -> float:
    """V rms in the last part of a step of the model, by another way than ensembles."""
    run = simulate(
        SERVO,
        TRIAL.duration,
        controller=CALM,
        reference=direction * KNOWN.step[1],
        gap=KNOWN.gap[0],
        input_bias=BIAS,
        friction=SERVO.torque_of(FRICTION),
        sample_rate=500.0,
    )
    return float(np.sqrt(np.mean(run.voltage[run.time > TRIAL.duration - TRIAL.last] ** 2)))


def test_the_band_contains_the_voltage_at_rest_after_steps_up_and_down() -> None:
    """What is fed forward for bias and friction adds up one way, and cancels the other way."""
    demands = Demands(machines=16, settled=0.5, beyond=Beyond(machines=0))
    found = confirm(SERVO, KNOWN, SETTING, demands, TRIAL)
    assert isinstance(found, Certificate), found
    up, down = voltage_held(1.0), voltage_held(-1.0)
    assert up > 0.12 > 0.06 > down
    assert up <= band_of(found).effort < 2.0 * up
    mirrored = replace(KNOWN, input_bias=(-KNOWN.input_bias[1], -KNOWN.input_bias[0]))
    other = confirm(SERVO, mirrored, Design(CALM.replace(feedforward=BIAS), 0.0), demands, TRIAL)
    assert isinstance(other, Certificate), other
    assert up <= band_of(other).effort < 2.0 * up


def test_every_machine_steps_in_its_own_direction() -> None:
    """The oracle: one `simulate` per machine."""
    members = draw(SERVO, KNOWN, 2, 2, 3)
    assert sorted(members.direction.ravel()) == [-1.0, -1.0, 1.0, 1.0]
    (found,) = assess([SETTING], members, TRIAL)
    for p, c in np.ndindex(2, 2):
        run = simulate(
            members.plants[p],
            TRIAL.duration,
            controller=CALM,
            reference=members.direction[p, c] * members.step[p, c],
            gap=members.gap[p, c],
            theta_d0=members.theta_d0[p, c],
            input_bias=members.input_bias[p, c],
            friction=members.friction[p, c],
            sample_rate=500.0,
        )
        error = (members.direction[p, c] * (run.reference - run.position))[::10]
        last = error[-200:]
        assert found.tail[p, c] == pytest.approx(np.abs(last).max(), rel=1e-6)
        past = max(last.mean() - error.min(), 0.0) / (members.step[p, c] + 2.0 * abs(last.mean()))
        assert found.overshoot[p, c] == pytest.approx(past, rel=1e-6, abs=1e-9)
        assert found.effort[p, c] == pytest.approx(np.sqrt(np.mean(run.voltage[::10][-200:] ** 2)), rel=1e-6)


def test_a_load_with_weight_is_verified_upwards_and_downwards() -> None:
    axis = Axis.preset("ball-screw")
    heavy = axis.replace(load=replace(axis.load, force=20.0))
    assert set(draw_independently(heavy, Uncertainty(), 8, 1).direction.ravel()) == {1.0, -1.0}


def test_one_direction_stands_for_both_where_nothing_tells_them_apart() -> None:
    assert set(draw_independently(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), 8, 1).direction.ravel()) == {1.0}
