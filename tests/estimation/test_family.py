"""Sampled responses and their derivatives: against the estimator's modes, scipy, and differences of the responses."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim

from servotwin.estimation.core.family import MOTOR, STRUCTURE, Family, InputHold, motor_family, structure_family
from servotwin.estimation.core.response import response
from servotwin.plant.servo import Servo

RATE = 5000.0
TIME = np.arange(1500) / RATE
SIGNAL = np.sin(9.0 * TIME) + 0.3 * np.cos(41.0 * TIME)


def scaled(servo: Servo, name: str, factor: float) -> Servo:
    field = {"k/m": "k", "c/m": "c", "pitch": "p"}.get(name, name)
    value = getattr(servo, field)
    return servo.replace(**{field: tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value})


@pytest.mark.parametrize("hold", list(InputHold))
@pytest.mark.parametrize(
    ("make", "names", "screw"),
    [(motor_family, MOTOR, np.inf), (structure_family, STRUCTURE, np.inf), (structure_family, STRUCTURE, 3e5)],
)
def test_derivatives_are_those_of_the_responses(make, names, screw, hold):
    servo = Servo.preset("paper").replace(m=(5.2, 4.0, 6.1), k=(1e4, 9e3, 1.2e4), c=(36.9, 30.0, 45.0), k_d=screw)
    family, step = make(servo), 1e-5
    start = np.linspace(0.5, 1.0, family.system.B.size)
    found = family.sampled(RATE, hold).respond(SIGNAL, start)
    for index, name in enumerate(names):
        up, down = (
            make(scaled(servo, name, np.exp(sign * step))).sampled(RATE, hold).respond(SIGNAL, start)[0]
            for sign in (1.0, -1.0)
        )
        difference = (up - down) / (2.0 * step)
        scale = np.abs(difference).max() + 1e-9 * np.abs(found[0]).max()
        np.testing.assert_allclose(found[index + 1] / scale, difference / scale, atol=2e-6)


def test_the_discrete_systems_derivative_by_complex_step():
    servo, h = Servo.preset("paper"), 1e-30
    family = motor_family(servo)
    sampled = family.sampled(RATE, InputHold.CONSTANT)
    for index, one in enumerate(family.by):
        flow = np.zeros((4, 4), complex)
        flow[:3, :3] = family.system.A + 1j * h * one.A
        flow[:3, 3] = family.system.B + 1j * h * one.B
        exact = expm(flow / RATE).imag / h
        np.testing.assert_allclose(sampled.F[index + 1], exact[:3, :3], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(sampled.now[index + 1], exact[:3, 3], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("hold", list(InputHold))
def test_responses_as_scipy_gives_them(hold):
    system = motor_family(Servo.preset("paper")).system
    expected = lsim(
        (system.A, system.B[:, None], system.C[None], [[0.0]]), SIGNAL, TIME, interp=hold is InputHold.LINEAR
    )[1]
    found = motor_family(Servo.preset("paper")).sampled(RATE, hold).respond(SIGNAL)[0]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("masses", [2, 3, 5])
def test_the_structure_responds_as_the_estimators_modes_do(masses):
    """Two forms of the same system: modes there, matrices here; they begin one sample apart, hence the zero."""
    servo = Servo.preset("paper").replace(n=masses)
    signal = SIGNAL - SIGNAL[0]
    modes = response(servo, RATE).respond(signal[None])[0]
    found = structure_family(servo).sampled(RATE).respond(signal)[0]
    np.testing.assert_allclose(found, modes, atol=1e-9 * np.abs(modes).max())


def test_free_motion_is_what_an_initial_state_adds():
    family = structure_family(Servo.preset("paper"))
    sampled, start = family.sampled(RATE), np.array([1e-3, -2e-3, 0.01, 0.02])
    whole, forced = sampled.respond(SIGNAL, start)[0], sampled.plain(SIGNAL[None])[0]
    np.testing.assert_allclose(whole - forced, start @ sampled.free(SIGNAL.size), atol=1e-15)


def test_a_selected_family_has_the_derivatives_of_its_parameters():
    family = structure_family(Servo.preset("paper"))
    chosen = family.select(("pitch", "k/m"))
    assert isinstance(chosen, Family)
    whole, part = family.sampled(RATE).respond(SIGNAL), chosen.sampled(RATE).respond(SIGNAL)
    np.testing.assert_array_equal(part, whole[[0, 3, 1]])
