"""Identifiability of the motor against what the coefficients of G1 say, and stated spreads against fits in noise."""

import math
from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import null_space, subspace_angles

from benchmarks.identifiability import (
    PRODUCTS,
    MotorCase,
    SensorNoise,
    identifiability,
    motor_cases,
    table,
)
from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import Gap, last_contacts
from servotwin.estimation.core.family import MOTOR, motor_family
from servotwin.estimation.window import Window
from servotwin.plant.backlash import play
from servotwin.plant.motor import Motor
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

GAP = math.radians(10.0)
# exponents of (J, L, R, k_T, k_B, p) in what the transfer functions hold
VOLTAGE_AND_ANGLE = np.array([[1, 1, 0, -1, 0], [1, 0, 1, -1, 0], [0, 0, 0, 0, 1]])  # G1's three coefficients
LOOP_OPEN = np.array([[0, 1, -1, 0, 0], [1, 1, 0, -1, -1]])  # its two poles
PITCH_TOO = np.array([[1, 1, 0, -1, -1, 0], [1, 0, 1, -1, -1, 0], [0, 0, 0, 0, -1, 1]])  # G1 p, the angle's unit free
EXPECTED = [np.zeros((0, 5)), LOOP_OPEN, VOLTAGE_AND_ANGLE, VOLTAGE_AND_ANGLE, VOLTAGE_AND_ANGLE, PITCH_TOO]


@lru_cache
def cases(preset: str = "paper") -> tuple[MotorCase, ...]:
    servo = Servo.preset(preset)
    run = simulate(servo, 6.1, reference=SquareWave(1e-3, 10.0), gap=GAP)
    window = Window.from_run(run, 5.0, 1.0)
    return motor_cases(window, servo, Gap(GAP, float(run.theta_d[25000])))


def test_the_exponents_are_those_of_the_transfer_function():
    """Scaling the parameters along a hidden direction leaves G1 as it is; along another it does not."""
    servo = Servo.preset("paper")
    values = np.array([servo.J, servo.L, servo.R, servo.k_T, servo.k_B])

    def monic(numbers: np.ndarray) -> np.ndarray:
        numerator, denominator = Motor(*numbers).transfer()
        return denominator[1:] / numerator

    for hidden in null_space(VOLTAGE_AND_ANGLE.astype(float)).T:
        np.testing.assert_allclose(monic(values * np.exp(0.3 * hidden)), monic(values), rtol=1e-12)
    for shown in VOLTAGE_AND_ANGLE:
        assert np.abs(monic(values * np.exp(0.3 * shown)) / monic(values) - 1.0).max() > 0.1


@pytest.mark.parametrize("preset", ["paper", "table1"])
def test_the_information_matrix_hides_what_the_structure_hides(preset):
    for case, expected in zip(cases(preset), EXPECTED, strict=True):
        shows = case.shows
        assert shows.rank == len(expected), case.measured
        hidden = null_space(expected.astype(float)) if len(expected) else np.eye(5)
        assert subspace_angles(hidden, shows.directions[shows.rank :].T).max() < 1e-5, case.measured


def test_products_are_identifiable_where_single_parameters_are_not():
    unknown, coasting, angle, step, delay, pitch = (case.stds for case in cases())
    assert all(math.isinf(std) for std in unknown.values())
    assert {name for name, std in coasting.items() if math.isfinite(std)} == {"J R/(k_T k_B)", "L/R"}
    for stds in (angle, step, delay):
        assert all(math.isinf(stds[name]) for name in ("J", "L", "R", "k_T"))
        assert stds["k_B"] < 1e-4
    assert math.isinf(pitch["k_B"])
    assert pitch["p/k_B"] == pytest.approx(delay["k_B"], rel=1e-6)
    assert angle["J R/(k_T k_B)"] < 1e-3 < 0.3 < angle["L/R"]
    assert step["J R/(k_T k_B)"] < 0.01
    assert delay["J R/(k_T k_B)"] > 3.0, "a motor that lags by 0.75 ms looks like a delay"


def test_stated_spread_is_that_of_fits_in_noise():
    """k_B and the mechanical time constant from voltage and angle, refitted in simulated noise."""
    servo, rate, noise = Servo.preset("paper"), 5000.0, 1e-3
    voltage = 3.0 * np.sin(40.0 * np.arange(3000) / rate) + 2.0 * np.sign(np.sin(25.0 * np.arange(3000) / rate))
    sampled = motor_family(servo).sampled(rate)
    sensitivities, free = sampled.respond(voltage)[1:], sampled.free(voltage.size)
    shows = identifiability(MOTOR, sensitivities, free, noise)
    rng = np.random.default_rng(4)
    noises = noise * rng.standard_normal((600, voltage.size))
    columns = np.vstack([sensitivities[[0, 4]], free]).T  # J moves J R / k_T alone, k_B the rest; L held
    found = np.linalg.lstsq(columns, noises.T, rcond=None)[0]
    held = identifiability(("J", "k_B"), sensitivities[[0, 4]], free, noise)
    assert np.std(found[0]) == pytest.approx(held.relative_std({"J": 1.0}), rel=0.1)
    assert np.std(found[1]) == pytest.approx(held.relative_std({"k_B": 1.0}), rel=0.1)
    assert shows.relative_std({"k_B": 1.0}) >= held.relative_std({"k_B": 1.0}) * (1.0 - 1e-9)
    assert held.information == pytest.approx(np.linalg.inv(np.cov(found[:2])), rel=0.35)


def test_less_noise_means_proportionally_less_spread():
    servo = Servo.preset("paper")
    run = simulate(servo, 6.1, reference=SquareWave(1e-3, 10.0), gap=GAP)
    window, at = Window.from_run(run, 5.0, 1.0), Gap(GAP, float(run.theta_d[25000]))
    tenth = motor_cases(window, servo, at, SensorNoise(math.radians(0.001), 1e-7))
    for one, other in zip(cases(), tenth, strict=True):
        for name, std in one.stds.items():
            assert other.stds[name] == pytest.approx(0.1 * std, rel=1e-6)


def test_last_contacts_explain_the_screw():
    rng = np.random.default_rng(0)
    theta_m = np.cumsum(rng.normal(0.0, 0.1, 400))
    last = last_contacts(theta_m, 0.7, 0.1, 0.0)
    screw = play(theta_m, 0.7, 0.1)
    touched = last >= 0
    np.testing.assert_allclose(np.abs(screw[touched] - theta_m[last[touched]]), 0.35, rtol=1e-12)
    assert np.all(screw[~touched] == 0.1)
    assert np.all(np.diff(last) >= 0)


def test_the_table_has_a_line_for_each_case():
    text = table(cases()).splitlines()
    assert len(text) == 2 + len(EXPECTED)
    assert all(line.count("|") == len(PRODUCTS) + 3 for line in text)
    assert "3 of 5" in text[4]


def test_what_is_missing_is_named():
    servo, at = Servo.preset("paper"), Gap(GAP, 0.0)
    blank = np.zeros(32)
    with pytest.raises(InvalidInput, match="voltage"):
        motor_cases(Window(blank, theta_m=blank, sample_rate=5000.0), servo, at)
    whole = Window(blank, theta_m=blank, voltage=blank, sample_rate=5000.0)
    with pytest.raises(InvalidInput, match="k_d"):
        motor_cases(whole, servo.replace(k_d=1e6), at)
    with pytest.raises(InvalidInput, match="noise"):
        identifiability(MOTOR, np.zeros((5, 10)), np.zeros((0, 10)), 0.0)
    with pytest.raises(InvalidInput, match="allowed are J, L"):
        cases()[0].shows.relative_std({"j": 1.0})
