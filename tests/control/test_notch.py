"""The notch: exact step, independent filter, the same bits in every engine, no bump where it comes or goes."""

import math

import numpy as np
import pytest
from scipy import signal

from servotwin.control import Controller, start, tick, transfer
from servotwin.errors import InvalidInput
from servotwin.plant.loop import continuous_law, pidf, sampled_law

HERTZ, DAMPING, DEPTH = 4.3, 0.5, 0.1
PLAIN = Controller(Kp=700.0, Ki=900.0, Kd=-20.0, Tf=0.05, sample_rate=1000.0)
NOTCHED = PLAIN.replace(notch_hz=HERTZ, notch_damping=DEPTH + 0.4, notch_depth=DEPTH)


def notch(damping: float = DAMPING, depth: float = DEPTH) -> tuple[list[float], list[float]]:
    omega = 2.0 * math.pi * HERTZ
    return [1.0, 2.0 * damping * depth * omega, omega**2], [1.0, 2.0 * damping * omega, omega**2]


@pytest.mark.parametrize("damping", [0.05, 0.5, 0.999999, 1.0])
@pytest.mark.parametrize("rate", [50.0, 1000.0, 20000.0])
def test_the_tick_is_scipys_filter_with_a_zero_order_hold(damping: float, rate: float) -> None:
    law = Controller(1.0, 0.0, 0.0, 1.0, sample_rate=rate, notch_hz=HERTZ, notch_damping=damping, notch_depth=DEPTH)
    inputs = np.random.default_rng(3).normal(size=400)
    state, given = start(0.0), []
    for value in inputs:
        state = tick(law.law(), state, value, 0.0)
        given.append(state.voltage)
    numerator, denominator, _ = signal.cont2discrete(notch(damping), 1.0 / rate, method="zoh")
    expected = signal.lfilter(numerator.ravel(), denominator, inputs)
    np.testing.assert_allclose(given, expected, rtol=0.0, atol=1e-10)


def test_the_response_at_the_centre_is_the_depth_and_elsewhere_one() -> None:
    system = pidf(PLAIN.replace(Ki=0.0, Kd=0.0, Kp=1.0, notch_hz=HERTZ, notch_damping=DAMPING, notch_depth=DEPTH))
    centre = 2.0 * math.pi * HERTZ
    gains = np.abs(system.response(np.array([1e-4 * centre, centre, 1e4 * centre])))
    np.testing.assert_allclose(gains, [1.0, DEPTH, 1.0], rtol=1e-6)


@pytest.mark.parametrize("controller", [NOTCHED, NOTCHED.replace(loop_filter_hz=20.0)])
def test_the_sampled_law_has_the_tick_s_response(controller: Controller) -> None:
    law, inputs = sampled_law(controller), np.random.default_rng(1).normal(size=300)
    x, expected = np.zeros(len(law.B)), []
    for y in inputs:
        expected.append(-float(law.C @ x + law.D * y))
        x = law.A @ x + law.B * y
    state, given = start(0.0), []
    for y in inputs:
        state = tick(controller.law(), state, 0.0, y)
        given.append(state.voltage)
    np.testing.assert_allclose(given, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_a_fast_sampled_law_is_the_continuous_one() -> None:
    rate, omega = 1e5, np.array([1.0, 10.0, 2.0 * math.pi * HERTZ, 100.0])
    sampled, exact = sampled_law(NOTCHED.replace(sample_rate=rate)), continuous_law(NOTCHED)
    z = np.exp(1j * omega / rate)
    responses = [
        [law.C @ np.linalg.solve(point * np.eye(len(law.B)) - law.A, law.B) + law.D for point in points]
        for law, points in ((sampled, z), (exact, 1j * omega))
    ]
    np.testing.assert_allclose(responses[0], responses[1], rtol=0.0, atol=1e-4 * np.abs(responses[1]).max())


@pytest.mark.parametrize(("old", "new"), [(PLAIN, NOTCHED), (NOTCHED, PLAIN), (NOTCHED, NOTCHED.replace(notch_hz=6.0))])
def test_a_notch_comes_and_goes_without_a_bump(old: Controller, new: Controller) -> None:
    state = start(0.0)
    for _ in range(300):
        state = tick(old.law(), state, 1e-3, 0.0)
    expected = tick(old.law(), state, 1e-3, 0.0).voltage
    changed = transfer(old.law(), new.law(), state, 1e-3, 0.0)
    assert tick(new.law(), changed, 1e-3, 0.0).voltage == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("push", [0.0, 0.05])
def test_a_notch_that_comes_at_rest_stays_at_rest(push: float) -> None:
    law, new = (each.replace(friction_feedforward=push, feedforward=-0.02).law() for each in (PLAIN, NOTCHED))
    state = start(0.0)._replace(integral=0.37, direction=1.0)
    state = transfer(law, new, state, 0.0, 0.0)
    for _ in range(500):
        state = tick(new, state, 0.0, 0.0)
        assert state.voltage == pytest.approx(0.35 + push, rel=1e-12)


def test_a_centre_far_beyond_the_rate_is_no_notch() -> None:
    far, plain = PLAIN.replace(notch_hz=1e308).law(), PLAIN.law()
    one = other = start(0.0)
    for k in range(100):
        one, other = tick(far, one, 1e-3, 1e-6 * k), tick(plain, other, 1e-3, 1e-6 * k)
        assert one.voltage == pytest.approx(other.voltage, rel=1e-12)


@pytest.mark.parametrize(
    ("key", "value"), [("notch_hz", -1.0), ("notch_damping", 0.0), ("notch_damping", 1.1), ("notch_depth", 1.0)]
)
def test_values_out_of_range_are_refused(key: str, value: float) -> None:
    with pytest.raises(InvalidInput, match=key):
        PLAIN.replace(**{key: value})
