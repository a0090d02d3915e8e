"""The chain of masses against Eq 13 and against an independent frequency-domain solve of Eq 9."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as poly

from servotwin.plant.motor import Motor
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain, transfer

FREQUENCIES = np.array([0.3, 3.0, 19.0, 26.0, 60.0, 75.0, 400.0])


@st.composite
def chains(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    n = draw(st.sampled_from([2, 3, 5]))
    m = [draw(st.floats(0.5, 20.0)) for _ in range(n)]
    k = [draw(st.floats(1e3, 1e5)) for _ in range(n)]
    c = [draw(st.floats(1.0, 200.0)) for _ in range(n)]
    return np.array(m), np.array(k), np.array(c)


def dynamic_stiffness(m: Array, k: Array, c: Array, s: complex) -> np.ndarray:
    """Eq 9 assembled link by link: every spring pulls on its two ends."""
    Z = np.diag(m * s**2).astype(complex)
    for i in range(m.size):
        link = np.zeros(m.size)
        link[i] = 1.0
        if i > 0:
            link[i - 1] = -1.0
        Z += (k[i] + c[i] * s) * np.outer(link, link)
    return Z


def prescribed_positions(m: Array, k: Array, c: Array, s: complex) -> np.ndarray:
    """All positions for q_1 = 1."""
    Z = dynamic_stiffness(m, k, c, s)
    return np.concatenate([[1.0], np.linalg.solve(Z[1:, 1:], -Z[1:, 0])])


def elastic_positions(m: Array, k: Array, c: Array, s: complex, k_d: float) -> np.ndarray:
    """All positions for d = 1 behind the spring k_d."""
    Z = dynamic_stiffness(m, k, c, s)
    Z[0, 0] += k_d
    return np.asarray(np.linalg.solve(Z, k_d * np.eye(m.size)[0]))


def positions(m: Array, k: Array, c: Array, s: complex, k_d: float) -> np.ndarray:
    return prescribed_positions(m, k, c, s) if math.isinf(k_d) else elastic_positions(m, k, c, s, k_d)


@given(chains(), st.sampled_from([math.inf, 1e5, 1e7]))
def test_matrices_and_polynomials_against_an_independent_solve(parts: tuple[Array, Array, Array], k_d: float) -> None:
    links = chain(*parts, k_d)
    numerator, denominator, _ = transfer(*parts, k_d)
    for s in 1j * FREQUENCIES:
        expected = positions(*parts, s, k_d)
        x = np.linalg.solve(s * np.eye(len(links.A)) - links.A, links.B_position + s * links.B_velocity)
        np.testing.assert_allclose(links.C @ x + links.D, expected, rtol=1e-9, atol=1e-12)
        ratio = poly.polyval(s, numerator) / poly.polyval(s, denominator)
        np.testing.assert_allclose(ratio, expected[-1], rtol=1e-8, atol=1e-12)
        if not math.isinf(k_d):
            force = links.reaction @ x + links.reaction_position
            np.testing.assert_allclose(force, k_d * (1.0 - expected[0]), rtol=1e-8, atol=1e-9 * k_d)


def test_the_transfer_function_is_eq_13() -> None:
    m, k, c, p = 5.2, 1e4, 36.9, 1e-3 / math.pi
    G2 = Servo.preset("paper").G2()
    np.testing.assert_allclose(G2.numerator, p * np.array([k**2, 2 * c * k, c**2]), rtol=1e-14)
    expected = [k**2, 2 * c * k, c**2 + 3 * k * m, 3 * c * m, m**2]
    np.testing.assert_allclose(G2.denominator, expected, rtol=1e-14)


def test_the_matrices_are_those_of_eq_10() -> None:
    m, k, c = 5.2, 1e4, 36.9
    links = Servo.preset("paper").chain()
    np.testing.assert_allclose(links.A[2:], [[-2 * k / m, k / m, -2 * c / m, c / m], [k / m, -k / m, c / m, -c / m]])
    np.testing.assert_array_equal(links.A[:2], [[0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(links.B_position, [0.0, 0.0, k / m, 0.0])
    np.testing.assert_allclose(links.B_velocity, [0.0, 0.0, c / m, 0.0])


@given(chains())
def test_first_mass_spring_and_damper_are_inert_with_a_rigid_screw(parts: tuple[Array, Array, Array]) -> None:
    changed = tuple(np.concatenate([[7.0], part[1:]]) for part in parts)
    np.testing.assert_array_equal(chain(*parts).A, chain(*changed).A)
    np.testing.assert_array_equal(transfer(*parts)[1], transfer(*changed)[1])


@given(chains(), st.floats(-1e-2, 1e-2))
@example((np.array([1.0, 1.0]), np.array([1e3, 3e3]), np.array([1.0, 1.0])), 5e-324)
def test_at_equilibrium_nothing_moves(parts: tuple[Array, Array, Array], d: float) -> None:
    rigid, elastic = chain(*parts), chain(*parts, 1e6)
    x = rigid.equilibrium(d)
    # The equilibrium is linear in d: below the smallest normal number digits are lost, and with them the ratio.
    least = np.finfo(float).tiny
    np.testing.assert_allclose(rigid.C @ x + rigid.D * d, d, rtol=1e-9, atol=least)  # every mass is where the screw is
    y = elastic.equilibrium(d)
    ground = parts[1][0]
    np.testing.assert_allclose(
        elastic.C @ y, d * 1e6 / (1e6 + ground), rtol=1e-8, atol=least
    )  # k_d against the ground spring
    force = elastic.reaction @ y + elastic.reaction_position * d
    np.testing.assert_allclose(force, d * 1e6 * ground / (1e6 + ground), rtol=1e-6, atol=1e6 * least)


@given(chains())
def test_a_very_stiff_screw_is_a_rigid_one(parts: tuple[Array, Array, Array]) -> None:
    for s in 1j * FREQUENCIES[:4]:
        errors = [
            abs(elastic_positions(*parts, s, k_d)[-1] / prescribed_positions(*parts, s)[-1] - 1.0)
            for k_d in (1e8, 1e10)
        ]
        assert errors[1] <= 0.02 * errors[0] + 1e-12  # first order in 1 / k_d


@pytest.mark.parametrize("omega", [0.1, 5.0, 1500.0, 1e4])
def test_motor_matrices_and_eq_8(omega: float) -> None:
    J, L, R, k_T, k_B = 5e-6, 1e-3, 12.0, 0.8, 0.1
    s = 1j * omega
    motor = Motor(J, L, R, k_T, k_B)
    A, B, E = motor.matrices()
    x = np.linalg.solve(s * np.eye(3) - A, B)
    expected = k_T / (s * (J * L * s**2 + J * R * s + k_B * k_T))
    np.testing.assert_allclose(x[2], expected, rtol=1e-12)
    numerator, denominator = motor.transfer()
    np.testing.assert_allclose(poly.polyval(s, numerator) / poly.polyval(s, denominator), expected, rtol=1e-12)
    y = np.linalg.solve(s * np.eye(3) - A, E)  # a torque sees the inertia and the braking of the shorted motor
    np.testing.assert_allclose(y[1] / (1.0 / (J * s + k_T * k_B / (L * s + R))), 1.0, rtol=1e-10)
