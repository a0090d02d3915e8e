"""Responses in one pass, and of several machines at once: equal to the long way round."""

import math

import numpy as np
import pytest

from servotwin.estimation.core.contacts import Gap, polygon
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.reduced import ReducedResponse
from servotwin.estimation.core.response import response
from servotwin.estimation.core.variants import variants
from servotwin.estimation.whitened.free_model import FACTORS, adapted
from servotwin.estimation.whitened.nearby import STEP, nearby
from servotwin.plant.servo import Servo

RATE = 5000.0
PAPER = Servo.preset("paper")
SERVOS = {
    "two masses": PAPER.replace(n=2),
    "three masses": PAPER,
    "five unequal masses": PAPER.replace(n=5, m=(1.0, 2.0, 3.0, 4.0, 5.0)),
    "overdamped": PAPER.replace(c=2000.0),
    "elastic screw": PAPER.replace(k_d=1e6),
}
FACTOR_SETS = [np.zeros(4), np.array([0.1, -0.4, 0.02, 0.08]), np.array([-0.2, 0.7, -0.01, -0.1])]


def walk(count: int, size: int = 4003) -> np.ndarray:
    return np.cumsum(0.05 * np.random.default_rng(7).standard_normal((count, size)), axis=1)


def assert_equal_but_for_rounding(found, expected, part=1e-12):
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= part * np.abs(expected).max()


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS)
@pytest.mark.parametrize("factor", [1, 2, 3, 9, 12, 40])
def test_one_pass_gives_what_response_and_decimation_give(servo, factor):
    model, reduce, angles = response(servo, RATE), decimation(factor), walk(3)
    reduced = ReducedResponse(model, reduce)
    assert_equal_but_for_rounding(reduced.respond(angles), reduce.rows(model.respond(angles)))
    assert_equal_but_for_rounding(reduced.velocities(angles), reduce.rows(model.velocities(angles)))
    assert_equal_but_for_rounding(reduced.free(angles.shape[1]), reduce.rows(model.free(angles.shape[1])))


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS)
def test_several_machines_at_once_respond_like_each_servo(servo):
    angles = walk(1)
    for found, factors in zip(variants(servo, FACTOR_SETS, RATE), FACTOR_SETS, strict=True):
        expected = response(adapted(servo, factors), RATE)
        assert_equal_but_for_rounding(found.respond(angles), expected.respond(angles), 1e-9)
        assert_equal_but_for_rounding(found.velocities(angles), expected.velocities(angles), 1e-9)
        assert found.static_gain == pytest.approx(expected.static_gain, rel=1e-9)
        assert found.unseen == pytest.approx(expected.unseen, rel=1e-12)


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS)
def test_a_screw_of_another_stiffness_responds_like_such_a_servo(servo):
    angles, stiffness = walk(1), [3e5, 1e6, 1e7]
    for found, factors, k_d in zip(variants(servo, FACTOR_SETS, RATE, stiffness), FACTOR_SETS, stiffness, strict=True):
        expected = response(adapted(servo, factors).replace(k_d=k_d), RATE)
        assert_equal_but_for_rounding(found.respond(angles), expected.respond(angles), 1e-9)


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS)
def test_motions_are_the_changes_of_the_position(servo):
    """The structure begins in motion, and its free motion changes with the machine too."""
    angle = 4.0 * np.sin(np.linspace(0.0, 9.0, 4003))
    screw = polygon(angle, Gap(math.radians(30.0), 0.1))[:1]
    factors, reduce = FACTOR_SETS[1], decimation(9)
    near = nearby(servo, tuple(factors), RATE, reduce, soft=False)
    shares = 1e-4 * np.random.default_rng(1).standard_normal(len(near.model.free(angle.size)))
    motions = near.motions(screw, near.model.respond(screw)[0], shares)
    for row in range(len(FACTORS)):
        there = ReducedResponse(response(adapted(servo, factors + STEP * np.eye(4)[row]), RATE), reduce)
        ahead, here = (one.respond(screw)[0] + shares @ one.free(angle.size) for one in (there, near.model))
        assert np.abs(motions[row] - (ahead - here) / STEP).max() <= 1e-7 * np.abs(motions).max()
