"""The observer of the Appendix: corrected and as printed, how fast it settles, and that it observes."""

import math

import numpy as np
import pytest
from measured_windows import RATE, measured, swinging
from scipy.signal import lsim

from servotwin.errors import InvalidInput
from servotwin.estimation.paper.observer import Observer, observer
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo

PAPER = Servo.preset("paper")
FIG_A1 = np.array([-1.5, 5.0, 0.1, 0.0]) * 1e-3


def as_printed(o: Observer) -> np.ndarray:
    """The gains of Eq A.9 with its alpha^i, l_3 first."""
    return np.array([math.comb(4, 4 - i) * o.alpha**i - o.denominator[i] for i in (3, 2, 1, 0)])


def test_coefficients_are_the_papers():
    o, m, k, c, p = observer(PAPER), PAPER.m, PAPER.k, PAPER.c, PAPER.p
    assert o.denominator == pytest.approx(
        [k**2 / m**2, 2 * c * k / m**2, c**2 / m**2 + 3 * k / m, 3 * c / m, 1.0], rel=1e-13
    )
    assert o.numerator == pytest.approx([k**2 * p / m**2, 2 * c * k * p / m**2, c**2 * p / m**2], rel=1e-13)
    assert o.A_o[:, 0] == pytest.approx(-o.denominator[3::-1], rel=1e-15)
    assert o.B[0] == 0.0
    assert o.static_gain == pytest.approx(p, rel=1e-13)


@pytest.mark.parametrize("alpha", [20.0, 40.0, 80.0])
def test_every_pole_lies_at_minus_alpha(alpha):
    o = observer(PAPER, alpha)
    binomial = [math.comb(4, i) * alpha**i for i in range(5)]
    assert np.poly(o.A) == pytest.approx(binomial, rel=1e-8)
    assert np.allclose(o.A, o.A_o - np.outer(o.L, o.C), rtol=1e-12, atol=0.0)
    # a fourfold eigenvalue moves by the fourth root of the rounding
    assert np.abs(np.linalg.eigvals(o.A) + alpha).max() < 1e-2 * alpha


def test_gains_as_printed_leave_three_poles_near_zero():
    """Erratum E6."""
    o = observer(PAPER)
    poles = np.sort_complex(np.linalg.eigvals(o.A_o - np.outer(as_printed(o), o.C)))
    assert poles[0].real == pytest.approx(-2.56e5, rel=1e-3)
    assert np.abs(poles[1:]) == pytest.approx(np.full(3, 0.0125), rel=0.5)
    assert poles[1:].real == pytest.approx(np.full(3, -0.0125), rel=1e-3)


def test_row_two_as_printed_moves_the_poles():
    """Erratum E5: with the right gains, -(a3 + l2) in row 2 of Eq A.7 leaves poles that hardly decay."""
    o = observer(PAPER)
    printed = o.A.copy()
    printed[1, 0] += o.denominator[2] - o.denominator[3]
    assert np.linalg.eigvals(printed).real.max() > -2.0


@pytest.mark.parametrize(("alpha", "settled"), [(20.0, 0.589), (40.0, 0.247), (80.0, 0.096)])
def test_settling_times_of_fig_a1(alpha, settled):
    """The last time at which the error is 2 % of 1.5 mm; the initial states are y and its derivatives."""
    o = observer(PAPER, alpha)
    times = np.arange(0.0, 1.0, 5e-4)
    error = np.abs(o.error(o.initial_state(FIG_A1), times))
    assert error[0] == pytest.approx(1.5e-3, rel=1e-12)
    assert times[np.flatnonzero(error > 0.02 * 1.5e-3)[-1]] == pytest.approx(settled, abs=1e-3)


def test_initial_state_has_the_given_derivatives():
    o = observer(PAPER)
    state = o.initial_state(FIG_A1)
    derivatives = [np.linalg.matrix_power(o.A_o, i)[0] @ state for i in range(4)]
    assert derivatives == pytest.approx(FIG_A1, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "servo",
    [
        PAPER.replace(n=2, m=(1.0, 3.0), k=(1e4, 2e4), c=(1.0, 30.0)),
        PAPER.replace(n=5, m=(1.0, 3.0, 2.0, 4.0, 1.0), c=30.0),
        PAPER.replace(k_d=1e6),
    ],
)
def test_forgets_the_initial_state_of_any_chain(servo):
    window = measured(math.radians(10.0), servo, theta_d0=0.02)
    o = observer(servo, 60.0)
    times = np.arange(round(2.0 * RATE)) / RATE
    theta_d = play(swinging(times), math.radians(10.0), 0.02)[round(RATE) :]
    error = np.abs(window.position - o.estimate(theta_d, window.position, RATE))
    size = np.ptp(window.position)
    assert error[0] > 1e-3 * size
    assert error[round(0.6 * RATE) :].max() < 1e-6 * size


def test_estimate_agrees_with_scipy_on_the_canonical_form():
    rng = np.random.default_rng(3)
    theta_d, position = np.cumsum(rng.standard_normal((2, 500)), axis=1) * [[0.1], [1e-4]]
    o = observer(PAPER)
    inputs = np.column_stack([np.append(0.0, theta_d), np.append(0.0, position)])
    system = (o.A, np.column_stack([o.B, o.L]), o.C[None, :], np.zeros((1, 2)))
    expected = lsim(system, inputs, np.arange(501) / RATE)[1][1:]
    assert np.abs(o.estimate(theta_d, position, RATE) - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("alpha", [0.0, -1.0, math.nan, math.inf])
def test_alpha_must_be_positive(alpha):
    with pytest.raises(InvalidInput, match="alpha"):
        observer(PAPER, alpha)
