"""The joint model's derivatives against differences of its residual, and its delay against shifted windows."""

import math

import numpy as np
import pytest
from measured_windows import measured

from servotwin.estimation.core.family import InputHold
from servotwin.estimation.joint.model import JointModel, cubic, cubic_slopes, margin_for
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

GAP = math.radians(10.0)
ANGLE = ("gap", "place", "delay", "k/m", "c/m", "pitch", "gap rate")
VOLTAGE = ("gap", "place", "delay", "k/m", "c/m", "k_B", "speed0", "current0")


def unchanged(rows: np.ndarray) -> np.ndarray:
    return rows


def angle_window() -> Window:
    return measured(GAP)


def voltage_window() -> Window:
    """A voltage (V) that moves the motor as far as in the paper's loop, over a position that does not matter."""
    t = np.arange(4000) / 5000.0
    voltage = 4.0 * np.cos(7.0 * t) + 2.0 * np.cos(21.0 * t + 1.0)
    return Window(1e-3 * np.sin(9.0 * t), voltage=voltage, sample_rate=5000.0)


@pytest.mark.slow
@pytest.mark.parametrize(("names", "make_window"), [(ANGLE, angle_window), (VOLTAGE, voltage_window)])
def test_derivatives_are_those_of_the_projected_residual(names, make_window):
    """The cost's gradient, which the projection's own derivatives do not enter, to the rounding of differences."""
    model = JointModel(make_window(), Servo.preset("paper"), names, InputHold.LINEAR, 12)
    values = dict.fromkeys(names, 0.01) | {"gap": 0.15, "place": 0.2, "delay": 3.3e-4, "speed0": 20.0}
    values = {name: values[name] for name in names}
    slopes = model.slopes(values, unchanged)
    assert slopes.cost == pytest.approx(model.cost(values, unchanged), rel=1e-9)
    gradient = 2.0 * slopes.jacobian @ slopes.residual
    steps = {"delay": 1e-8, "speed0": 1e-3, "current0": 1e-4, "gap rate": 1e-5}
    for name, expected in zip(names, gradient, strict=True):
        step = steps.get(name, 1e-6)
        up, down = (model.cost(values | {name: values[name] + sign * step}, unchanged) for sign in (1.0, -1.0))
        assert (up - down) / (2.0 * step) == pytest.approx(expected, rel=2e-4, abs=1e-6 * np.abs(gradient).max()), name


def test_the_truth_leaves_nothing():
    model = JointModel(measured(GAP), Servo.preset("paper"), ANGLE, InputHold.LINEAR, 12)
    truth = dict.fromkeys(ANGLE, 0.0) | {"gap": GAP, "place": 1.0}
    ends = [model.cost(truth | {"place": place}, unchanged) for place in (-1.0, 1.0)]
    rms = math.sqrt(min(ends) / model.measured.size)
    assert rms < 1e-8
    wrong = model.cost(truth | {"gap": 1.1 * GAP}, unchanged)
    assert math.sqrt(wrong / model.measured.size) > 1e-6


@pytest.mark.parametrize("samples", [-7.0, -2.5, 0.0, 0.3, 5.0, 9.75])
def test_a_delay_moves_the_answer(samples):
    """A smooth signal delayed by a fraction of a sample, and its slope."""
    model = JointModel(measured(GAP), Servo.preset("paper"), ANGLE, InputHold.LINEAR, margin_for(2e-3, 5000.0))
    t = np.arange(2000.0)
    kept = t[model.margin : -model.margin]
    shifted = model.delayed(np.sin(0.02 * t)[None], samples)[0]
    np.testing.assert_allclose(shifted, np.sin(0.02 * (kept - samples)), atol=1e-8)
    slope = model.delayed(np.sin(0.02 * t)[None], samples, slope=True)[0]
    np.testing.assert_allclose(slope, 0.02 * np.cos(0.02 * (kept - samples)), atol=1e-6)


@pytest.mark.parametrize("x", [0.0, 0.25, 0.9, 1.0])
def test_cubics_are_exact_for_cubics(x):
    nodes = np.array([-1.0, 0.0, 1.0, 2.0])
    for power in range(4):
        assert np.dot(cubic(x), nodes**power) == pytest.approx(x**power, abs=1e-14)
        slope = power * x ** (power - 1) if power else 0.0
        assert np.dot(cubic_slopes(x), nodes**power) == pytest.approx(slope, abs=1e-14)
