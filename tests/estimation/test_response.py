"""The structure's sampled response, the play operator's sensitivities and the projection, against independent forms."""

import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from measured_windows import RATE, position_of
from scipy.linalg import expm

from servotwin.estimation.core.contacts import BY_GAP, BY_RATE, BY_START, SCREW, Gap, contacts, travel
from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.core.response import response
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo
from servotwin.simulation import simulate

PAPER = Servo.preset("paper")
CRITICAL = 2.0 * math.sqrt(5.2e4)
SERVOS = [
    PAPER,
    PAPER.replace(n=2),
    PAPER.replace(n=5, m=(1.0, 2.0, 3.0, 4.0, 5.0)),
    PAPER.replace(c=2000.0),
    PAPER.replace(k_d=1e6),
    PAPER.replace(n=2, k=(1e4, 5e3), c=(0.0, 2.0 * CRITICAL)),
]


def walk(seed: int, size: int = 4000) -> np.ndarray:
    angles = np.cumsum(0.05 * np.random.default_rng(seed).standard_normal(size))
    return angles - angles[0]


@pytest.mark.parametrize("servo", SERVOS)
def test_the_response_is_scipys(servo):
    angles, times = walk(1), np.arange(4000) / RATE
    expected = position_of(servo, angles, times)
    found = response(servo, RATE).respond(angles[None])[0]
    assert np.abs(found - expected).max() < 1e-11 * np.abs(expected).max()


def test_critical_damping_has_no_eigenvectors_and_still_a_response():
    servo = PAPER.replace(n=2, c=CRITICAL / 2.0, k=(5e3, 5e3))
    angles, times = walk(2), np.arange(4000) / RATE
    for c in (CRITICAL, CRITICAL / math.sqrt(2.0), CRITICAL / 2.0):
        servo = servo.replace(c=c)
        expected = position_of(servo, angles, times)
        assert np.abs(response(servo, RATE).respond(angles[None])[0] - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize("servo", SERVOS)
def test_velocity_is_the_derivative(servo):
    times = np.arange(4000) / RATE
    angles = np.sin(2.0 * times) ** 3
    model = response(servo, RATE)
    position, velocity = model.respond(angles[None])[0], model.velocities(angles[None])[0]
    assert np.gradient(position, 1.0 / RATE)[50:-1] == pytest.approx(velocity[50:-1], abs=2e-4 * np.abs(velocity).max())


@pytest.mark.parametrize("servo", SERVOS[:3])
def test_free_motions_are_those_of_the_matrices(servo):
    chain, samples = servo.chain(), 300
    motions = response(servo, RATE).free(samples)
    assert len(motions) == 2 * (servo.n - 1)
    step = expm(chain.A / RATE)
    state = np.random.default_rng(3).standard_normal(len(chain.A))
    free = []
    for _ in range(samples):
        free.append(chain.C_last @ state)
        state = step @ state
    left = project_out(orthonormal(motions), np.array([free]))
    assert np.abs(left).max() < 1e-9 * np.abs(free).max()


def test_a_simulated_run_is_explained_to_rounding():
    """Position of a run with a gap, from its own screw angle and free motions: what is left is the hold's error."""
    run = simulate(PAPER, 2.0, reference=1e-3, gap=math.radians(10.0))
    part = slice(4000, 9000)
    model = response(PAPER, RATE)
    basis = orthonormal(model.free(5000))
    left = project_out(basis, (run.position[part] - model.respond(run.theta_d[None, part])[0])[None])
    assert np.abs(left).max() < 2e-9


def test_contacts_are_the_play_operator():
    angles = walk(4)
    for gap, start in ((0.0, 0.0), (0.3, 0.1), (1.0, -0.5), (50.0, 0.0)):
        rows = contacts(angles, Gap(gap, start))
        assert np.array_equal(rows[SCREW], play(angles, gap, start))


@examples(60, deadline=None)
@given(st.floats(0.05, 2.0), st.floats(-1.0, 1.0), st.integers(0, 10**6))
def test_sensitivities_are_exact(gap, share, seed):
    """Piecewise affine: a small step changes the screw's angle by exactly its derivative."""
    angles = walk(seed, 500)
    at = Gap(gap, 0.5 * gap * share)
    rows = contacts(angles, at)
    step = 1e-9
    moved = {
        BY_GAP: at._replace(gap=gap + step),
        BY_START: at._replace(theta_d0=at.theta_d0 + step),
        BY_RATE: at._replace(rate=step * 1e-2),
    }
    for row, other in moved.items():
        size = step * 1e-2 if row == BY_RATE else step
        difference = (contacts(angles, other)[SCREW] - rows[SCREW]) / size
        assert np.mean(np.abs(difference - rows[row]) < 1e-4 * max(1.0, np.abs(rows[row]).max())) > 0.98


def test_travel_counts_both_contacts():
    angles = np.concatenate([np.linspace(0.0, 3.0, 300), np.linspace(3.0, -1.0, 400)])
    found = travel(angles, Gap(1.0, 0.0))
    assert found == pytest.approx((2.5, 3.0, 1.0))


def test_projection_removes_what_it_spans_and_nothing_else():
    rng = np.random.default_rng(5)
    columns = rng.standard_normal((4, 200)) * np.array([[1.0], [1e6], [1e-6], [1.0]])
    columns = np.vstack([columns, columns[0] + columns[3]])
    basis = orthonormal(columns)
    assert basis.shape == (4, 200)
    assert basis @ basis.T == pytest.approx(np.eye(4), abs=1e-14)
    assert np.abs(project_out(basis, columns)).max() < 1e-14 * 1e6
    other = rng.standard_normal((1, 200))
    expected = other[0] - columns[:4].T @ np.linalg.lstsq(columns[:4].T, other[0], rcond=None)[0]
    assert project_out(basis, other)[0] == pytest.approx(expected, abs=1e-9)
    grown = orthonormal(other, basis)
    assert np.array_equal(grown[:4], basis)
    assert grown.shape == (5, 200)
