"""The residual of Eqs 22-23: zero at the truth, piecewise affine, smooth through a gap of zero, free of scale."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from measured_windows import RATE, measured, swinging

from servotwin.estimation.paper.observer import observer
from servotwin.estimation.paper.residual import PlayResidual, screw_motion
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo

SERVO = Servo.preset("paper")
TEN = math.radians(10.0)


def of(window, skip=1250, scale=1.0):
    theta_m, position = scale * window.theta_m, scale * window.position
    return PlayResidual.of(theta_m, position, RATE, observer(SERVO), SERVO.p, skip)


def truth(residual, window, gap=TEN):
    """(gap, theta_d0) in the residual's units; the screw's first angle is in contact or known from the motor's past."""
    times = np.arange(round((window.start + 0.1) * RATE)) / RATE

    return np.array([gap, play(swinging(times), gap)[round(window.start * RATE)]]) / residual.scale


def test_the_true_gap_leaves_only_what_the_observer_has_not_forgotten():
    window = measured(TEN)
    residual = of(window, skip=0)
    left = np.abs(residual.values(truth(residual, window)))
    assert left[:50].max() > 0.05
    assert left[3000:].max() < 1e-6


@given(st.floats(0.5, 20.0), st.floats(-0.9, 0.9))
def test_the_gradient_is_that_of_the_cost(gap_deg, place):
    residual = of(measured(TEN))
    gap = math.radians(gap_deg) / residual.scale
    point = np.array([gap, residual.theta_m[0] + 0.5 * place * gap])
    _, gradient = residual.slope(point)
    h = 1e-6
    central = [(residual.cost(point + h * e) - residual.cost(point - h * e)) / (2.0 * h) for e in np.eye(2)]
    assert gradient == pytest.approx(central, abs=2e-6)


def test_sensitivities_are_exact_where_nothing_switches():
    """The residual is piecewise affine: a small step lies on the tangent but where contact switches."""
    residual = of(measured(TEN))
    point = truth(residual, measured(TEN)) * np.array([1.05, 1.0])
    by_gap, by_start = residual.sensitivities(point)
    step = np.array([1e-7, 0.0])
    assert residual.values(point + step) - residual.values(point) == pytest.approx(1e-7 * by_gap, abs=1e-11)
    assert np.abs(by_gap).max() > 0.5
    assert np.abs(by_start).max() < 1e-2


def test_the_first_screw_angle_has_no_effect_beyond_the_gap():
    residual = of(measured(TEN))
    gap, first = TEN / residual.scale, float(residual.theta_m[0])
    edge = residual.cost(np.array([gap, first + 0.5 * gap]))
    assert residual.cost(np.array([gap, first + 5.0 * gap])) == edge
    assert residual.slope(np.array([gap, first - gap]))[1][1] == 0.0


@pytest.mark.slow
def test_the_cost_is_smooth_through_zero():
    """A negative gap mirrors the screw at the motor: value and slope continue."""
    residual = of(measured(math.radians(1.0)))
    first = float(residual.theta_m[0])
    h = 1e-6
    below, at, above = (residual.cost(np.array([gap, first])) for gap in (-h, 0.0, h))
    assert (above - at) / h == pytest.approx((at - below) / h, rel=1e-2)
    mirrored = 2.0 * residual.values(np.array([0.0, first])) - residual.values(np.array([0.01, first + 1e-3]))
    assert residual.values(np.array([-0.01, first - 1e-3])) == pytest.approx(mirrored, abs=1e-13)


@pytest.mark.parametrize("scale", [2.0**-9, 2.0**5])
def test_scaling_every_signal_changes_no_bit(scale):
    window = measured(TEN)
    one, other = of(window), of(window, scale=scale)
    assert other.scale == scale * one.scale
    point = truth(one, window) * 0.9
    assert np.array_equal(one.values(point), other.values(point))


@given(st.floats(0.0, 3.0), st.floats(-4.0, 4.0), st.integers(0, 200), st.integers(0, 2**31))
def test_screw_motion_is_that_of_the_play_operator(gap, start, skip, seed):
    motor = np.cumsum(np.random.default_rng(seed).standard_normal(300))
    screw = play(motor, gap, start)
    steps = np.diff(screw)[skip:]
    upward, downward, free = screw_motion(motor, 0.5 * gap, start, skip)
    assert upward == pytest.approx(steps[steps > 0.0].sum(), abs=1e-9)
    assert downward == pytest.approx(-steps[steps < 0.0].sum(), abs=1e-9)
    assert free == pytest.approx(np.ptp((motor - screw)[skip + 1 :]), abs=1e-12)
    assert free <= gap + 1e-12
