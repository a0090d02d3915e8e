"""The compiled residual and descent, against the same put together from their parts and against scipy."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from servotwin.estimation.core.contacts import polygon
from servotwin.estimation.core.least_squares import project_out
from servotwin.estimation.core.response import response
from servotwin.estimation.core.whitening import burg
from servotwin.estimation.whitened.descent import mix_places
from servotwin.estimation.whitened.reduction import Misfit, Point, Reduction
from servotwin.estimation.whitened.search import GAP_ONLY, PLACE_ONLY, descend
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

GAP = math.radians(10.0)
POINTS = [Point(0.0, 0.0), Point(GAP, -1.0), Point(0.9 * GAP, 0.3), Point(2.0 * GAP, 1.0), Point(30.0, -0.2)]


def misfit_of(masses: int, rate: float, coloured: bool) -> Misfit:
    """A window of the paper's loop; at 400 Hz nothing is decimated."""
    servo = Servo.preset("paper").replace(n=masses)
    law = servo.controller
    share = 1.0 if masses < 5 else 0.1  # the paper's gains do not stabilise five masses
    servo = servo.replace(Kp=share * law.Kp, Ki=share * share * law.Ki, Kd=share * law.Kd)
    servo.check_loop()
    run = simulate(servo, 8.0, reference=SquareWave(1e-3, 10.0), gap=GAP, tolerance=servo.tolerance_for(GAP))
    window = Window.from_run(run, 5.0, 1.0)
    every = round(window.sample_rate / rate)
    noise = 1e-6 * np.random.default_rng(masses).standard_normal(window.position.size)
    angle, position = window.theta_m[::every], (window.position + noise)[::every]
    reduction = Reduction.of(angle, position, response(servo, window.sample_rate / every))
    if not coloured:
        return reduction.coarse()
    drift = np.cumsum(np.random.default_rng(1).standard_normal(reduction.position.size))
    return reduction.misfit(burg(1e-6 * drift[None], 8), Point(GAP, 0.0))


def parts(misfit: Misfit, point: Point) -> np.ndarray:
    """(3, M) residual and derivatives, step by step at the full rate."""
    screw = polygon(misfit.theta_m, point.screw(misfit.theta_m[0], misfit.rate))
    mix_places(screw, point.gap, point.place)
    moved = misfit.reduced.decimation.rows(misfit.reduced.response.respond(screw[:3]))
    rows = np.zeros((3, misfit.position.size))
    rows[:, : moved.shape[1]] = -(moved if misfit.noise is None else misfit.noise.whiten(moved))
    rows[0] += misfit.position
    return project_out(misfit.basis, rows)


CASES = [(2, 5000.0, False), (3, 5000.0, True), (5, 5000.0, True), (3, 400.0, False), (2, 400.0, True)]


@pytest.mark.parametrize("case", CASES)
def test_residual_and_derivatives_are_those_of_the_parts(case):
    misfit = misfit_of(*case)
    costs = misfit.costs(POINTS)
    for point, cost in zip(POINTS, costs, strict=True):
        expected = parts(misfit, point)
        found = descend(misfit, point, 100.0, 1e-9, steps=1).slopes
        assert cost == found.cost == pytest.approx(float(expected[0] @ expected[0]), rel=1e-9)
        sizes = np.linalg.norm(expected, axis=1)
        scale = np.abs(misfit.data.position).max()
        assert np.abs(found.residual - expected[0]).max() < 1e-9 * scale
        assert np.abs(found.jacobian - expected[1:]).max() < 1e-9 * max(sizes[1], sizes[2], scale)


@pytest.mark.parametrize("case", CASES)
def test_a_descent_in_the_gap_ends_where_scipys_does(case):
    misfit = misfit_of(*case)
    place = descend(misfit, Point(1.1 * GAP, 0.2), 3.0 * GAP, 1e-12).point.place
    end = descend(misfit, Point(1.03 * GAP, place), 3.0 * GAP, 1e-13, free=GAP_ONLY, gain=1e-15)
    near = (0.98 * end.point.gap, 1.02 * end.point.gap)
    judge = minimize_scalar(lambda gap: misfit.costs([Point(gap, place)])[0], bounds=near, options={"xatol": 1e-12})
    assert end.converged
    assert end.slopes.cost <= judge.fun * (1.0 + 1e-9)


def test_what_is_held_stays_and_limits_are_kept():
    misfit = misfit_of(3, 5000.0, True)
    start = Point(1.3 * GAP, -0.4)
    assert descend(misfit, start, 3.0 * GAP, 1e-9, free=GAP_ONLY).point.place == start.place
    assert descend(misfit, start, 3.0 * GAP, 1e-9, free=PLACE_ONLY).point.gap == start.gap
    assert descend(misfit, Point(0.4 * GAP, 0.0), 0.5 * GAP, 1e-9).point.gap <= 0.5 * GAP
    few = descend(misfit, Point(3.0 * GAP, 0.9), 4.0 * GAP, 1e-12, steps=3, gain=1e-14)
    assert few.evaluations <= 3
