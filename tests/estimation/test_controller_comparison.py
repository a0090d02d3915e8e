"""Is a window's voltage that of the controller that is stated for it? Windows of exact loops, and of the law alone."""

import math

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.control.law import start, tick
from servotwin.estimation import controller as comparison
from servotwin.estimation.controller import compare_controller
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

SERVO = Servo.preset("paper")
LAW = SERVO.controller
GAP = math.radians(10.0)
ZONE = SERVO.tolerance_for(GAP)


def loop(controller, tolerance=ZONE, begin=20.0, duration=1.5, rate=5000.0, **changes):
    """A window of the paper's machine under a controller."""
    run = simulate(
        SERVO, begin + duration + 0.1, controller=controller, reference=SquareWave(1e-3, 20.0), gap=GAP,
        tolerance=tolerance, theta_d0=0.2 * GAP, sample_rate=rate, **changes,
    )  # fmt: skip
    return Window.from_run(run, begin, duration)


def by_hand(controller, tolerance, state=None, count=4000, scale=1.0, rate=2000.0):
    """A window whose voltage is exactly the law's, from any initial state: position and reference are given."""
    time = np.arange(count) / rate
    position = scale * (1e-3 * np.sin(9.0 * time) + 3e-4 * np.sin(40.0 * time + 1.0))
    reference = scale * 1e-3 * np.sign(np.sin(4.0 * time + 0.4))
    return under(controller, tolerance, state, reference, position, rate)


def from_the_zone(controller, integral=0.0):
    """A window that begins at rest in the dead zone, where the law hides its integral until a step."""
    time = np.arange(4000) / 2000.0
    after = np.maximum(time - 0.1, 0.0)
    position = 5e-5 + 1e-3 * (1.0 - np.exp(-6.0 * after) * np.cos(20.0 * after))
    reference = np.where(time < 0.1, 0.0, 1e-3)
    state = start(float(position[0]))._replace(integral=integral, reference=0.0, active=0.0)
    return under(controller, 1e-4, state, reference, position)


def under(controller, tolerance, state, reference, position, rate=2000.0):
    """A window whose voltage is the law's for a reference and a position."""
    count = position.size
    law = controller.replace(sample_rate=rate).law(tolerance)
    state, voltage = state or start(float(position[0])), np.empty(count)
    for k in range(count):
        state = tick(law, state, float(reference[k]), float(position[k]))
        voltage[k] = state.voltage
    return Window(position, voltage=voltage, reference=reference, sample_rate=rate)


@pytest.mark.parametrize(
    "controller",
    [
        LAW,
        LAW.replace(Ki=0.0, feedforward=0.3),
        LAW.replace(voltage_limit=2.5),
        LAW.replace(integral_only=True, velocity_feedforward=20.0),
        LAW.replace(velocity_feedforward=20.0, friction_feedforward=0.3),
        LAW.replace(enter=0.5, leave=1.5),
        LAW.replace(Ki=0.03 * LAW.Ki, notch_hz=4.3),
    ],
    ids=["paper", "without integral", "limited", "integral only", "fed forward", "hysteresis", "notch"],
)
def test_a_law_explains_its_own_voltage_whatever_its_state_was_at_the_beginning(controller):
    tolerance = 2e-4
    state = start(0.0)._replace(integral=0.7, derivative=4e-4, offset=-0.2, voltage=0.4, reference=-1e-3)
    state = state._replace(notch_band=0.3, notch_low=0.5)
    if controller.Ki == 0.0:
        state = state._replace(integral=0.0)
    made = compare_controller(by_hand(controller, tolerance, state), controller, tolerance)
    assert made.agrees
    assert made.sentence == ""
    assert made.unexplained < 1e-9 * made.swing


@pytest.mark.parametrize("integral", [-1.4, 1.4])
@pytest.mark.parametrize("tracking", [None, 0.05], ids=["usual", "fast"])
def test_an_integral_that_the_dead_zone_hides_until_a_limit_is_found(integral, tracking):
    """Each window of robot-joint under the paper's dead zone begins so: the limit leaves a part of the integral."""
    law = LAW.replace(Tf=0.1 * LAW.Tf, voltage_limit=2.8, tracking_time=tracking)
    window = from_the_zone(law, integral)
    limited = np.flatnonzero(np.abs(window.voltage) == 2.8)
    assert limited.size > 0
    assert not np.any(window.voltage[: limited[0]])
    made = compare_controller(window, law, 1e-4)
    assert made.agrees
    assert made.unexplained < 1e-6 * made.swing


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_no_vast_state_that_fades_in_the_dead_zone_explains_another_controller(factor):
    law = Controller(Kp=1000.0, Ki=100.0, Kd=100.0, Tf=0.01)
    other = law.replace(Kp=factor * law.Kp, Ki=factor * law.Ki, Kd=factor * law.Kd)
    assert compare_controller(from_the_zone(law), law, 1e-4).agrees
    made = compare_controller(from_the_zone(other), law, 1e-4)
    assert not made.agrees
    assert made.unexplained / made.swing == pytest.approx(abs(1.0 - 1.0 / factor), rel=0.02)


@pytest.mark.parametrize("factors", [(0.5, 0.3, 1.0), (1.0, 1.0, 0.4), (1.4, 0.6, 1.2), (-1.0, -1.0, -1.0)])
def test_gains_that_were_changed_are_said_in_stated_ones(factors):
    changed = LAW.replace(Kp=factors[0] * LAW.Kp, Ki=factors[1] * LAW.Ki, Kd=factors[2] * LAW.Kd)
    made = compare_controller(by_hand(changed, 0.0), LAW, 0.0)
    assert not made.agrees
    assert [made.factors[name] for name in ("Kp", "Ki", "Kd")] == pytest.approx(factors, abs=0.02)
    assert f"it fits Kp {factors[0]:.2g}, Ki {factors[1]:.2g}" in made.sentence


def test_gains_that_explain_a_voltage_are_not_looked_for_again_at_every_delay(monkeypatch):
    searched, fit = [], comparison._factors
    monkeypatch.setattr(comparison, "_factors", lambda *given: searched.append(fit(*given)) or searched[-1])
    made = compare_controller(by_hand(LAW.replace(Kp=0.5 * LAW.Kp), 0.0), LAW, 0.0)
    assert searched == [made.factors]
    assert made.factors["Kp"] == pytest.approx(0.5, abs=0.02)
    searched.clear()
    assert compare_controller(loop(LAW), LAW, 0.0).factors == {}
    assert len(searched) == comparison._DELAYS


def test_an_edge_that_ignores_the_velocity_feedforward_is_said_so():
    """An older one does; its gains are the stated ones."""
    stated = LAW.replace(velocity_feedforward=400.0)
    made = compare_controller(by_hand(LAW, 0.0), stated, 0.0)
    assert not made.agrees
    assert [made.factors[name] for name in ("Kp", "Ki", "Kd")] == pytest.approx([1.0] * 3, abs=0.02)
    assert made.factors["velocity feedforward"] == pytest.approx(0.0, abs=0.02)
    halved = by_hand(stated.replace(velocity_feedforward=200.0, Kp=0.6 * LAW.Kp), 0.0)
    factors = compare_controller(halved, stated, 0.0).factors
    assert [factors[name] for name in ("Kp", "velocity feedforward")] == pytest.approx([0.6, 0.5], abs=0.02)


def test_an_edge_that_ignores_the_friction_feedforward_is_said_so():
    stated = LAW.replace(friction_feedforward=3.0)
    made = compare_controller(by_hand(LAW, 0.0), stated, 0.0)
    assert not made.agrees
    assert [made.factors[name] for name in ("Kp", "Ki", "Kd")] == pytest.approx([1.0] * 3, abs=0.02)
    assert made.factors["friction feedforward"] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("stated", [0.0, 3.0 * ZONE])
def test_another_dead_zone_is_recognised_and_no_gains_are_named_for_it(stated):
    made = compare_controller(loop(LAW), LAW, stated)
    assert not made.agrees
    assert made.factors == {}
    assert "and so do other gains" in made.sentence


@pytest.mark.parametrize("rate", [500.0, 5000.0])
@pytest.mark.parametrize(
    "controller",
    [LAW, LAW.replace(sample_rate=5000.0, loop_filter_hz=20.0), LAW.replace(voltage_limit=2.0)],
    ids=["continuous", "sampled with a loop filter", "limited"],
)
def test_a_loop_agrees_with_its_own_controller_at_any_recording_rate(controller, rate):
    made = compare_controller(loop(controller, rate=rate, begin=19.8), controller, ZONE)
    assert made.agrees
    assert made.unexplained < 0.06 * made.swing


@pytest.mark.parametrize("delay", [1, 3])
def test_a_voltage_that_reaches_the_motor_some_samples_later_is_still_the_laws(delay):
    window = by_hand(LAW.replace(voltage_limit=1.0), 2e-4)
    late = np.concatenate([np.full(delay, window.voltage[0]), window.voltage[:-delay]])
    made = compare_controller(window.replace(voltage=late), LAW.replace(voltage_limit=1.0), 2e-4)
    assert made.agrees


def test_scales_do_not_matter():
    """Metres a million times smaller and gains as much larger: the same voltages and the same shares."""
    changed = LAW.replace(Kp=0.5 * LAW.Kp)
    usual = compare_controller(by_hand(changed, 2e-4), LAW, 2e-4)
    tiny = LAW.replace(Kp=1e6 * LAW.Kp, Ki=1e6 * LAW.Ki, Kd=1e6 * LAW.Kd)
    small = compare_controller(by_hand(tiny.replace(Kp=0.5 * tiny.Kp), 2e-10, scale=1e-6), tiny, 2e-10)
    assert not usual.agrees
    assert small.unexplained / small.swing == pytest.approx(usual.unexplained / usual.swing, rel=1e-6)


def test_a_window_of_few_samples_tells_another_controller_too():
    """Those of the ball screw have 400."""
    window = by_hand(LAW, 0.0)
    short = Window(
        window.position[:400], voltage=window.voltage[:400], reference=window.reference[:400], sample_rate=2000.0
    )
    assert compare_controller(short, LAW, 0.0).agrees
    made = compare_controller(short, LAW.replace(Kp=4.0 * LAW.Kp, Kd=4.0 * LAW.Kd), 0.0)
    assert not made.agrees
    assert "not that of the stated controller" in made.sentence


@pytest.mark.parametrize(
    ("misread", "said"),
    [
        (lambda voltage: 0.0 * voltage, "the voltage moves by 0 V rms where the stated controller would move it by"),
        (lambda voltage: 0.0 * voltage + 2.0, "the voltage moves by 0 V rms where"),
        (lambda voltage: 1e-3 * voltage, "is its channel dead, or in another unit?"),
        (lambda voltage: -voltage, "it fits Kp -1, Kd -1 times the stated"),
    ],
    ids=["dead", "stuck", "millivolts", "reversed"],
)
def test_a_voltage_that_is_not_the_motors_is_said_so(misread, said):
    window = loop(LAW.replace(Ki=0.0), input_bias=0.05)
    made = compare_controller(window, LAW.replace(Ki=0.0), ZONE)
    assert made.agrees
    assert not made.misread
    wrong = compare_controller(window.replace(voltage=misread(window.voltage)), LAW.replace(Ki=0.0), ZONE)
    assert wrong.misread
    assert said in wrong.sentence


def test_other_gains_are_no_misread_voltage():
    made = compare_controller(by_hand(LAW.replace(Kp=0.3 * LAW.Kp, Kd=0.3 * LAW.Kd, Ki=0.0), 0.0), LAW, 0.0)
    assert not made.agrees
    assert not made.misread


def test_a_window_that_shows_nothing_gives_no_verdict():
    window = by_hand(LAW, 0.0)
    noise = np.random.default_rng(3).normal(0.0, 1e-3, window.position.size)
    assert compare_controller(window.replace(position=window.position + noise), LAW, 0.0) is None
    still = Window(np.zeros(4000), voltage=np.zeros(4000), reference=np.zeros(4000), sample_rate=2000.0)
    assert compare_controller(still, LAW, 0.0) is None
    assert compare_controller(Window(window.position, sample_rate=2000.0), LAW, 0.0) is None
    short = Window(
        window.position[:190], voltage=window.voltage[:190], reference=window.reference[:190], sample_rate=2000.0
    )
    assert compare_controller(short, LAW, 0.0) is None


def test_a_pure_proportional_law_has_one_factor():
    law = Controller(Kp=1000.0, Ki=0.0, Kd=0.0, Tf=0.1)
    made = compare_controller(by_hand(law.replace(Kp=700.0), 0.0), law, 0.0)
    assert list(made.factors) == ["Kp"]
    assert made.factors["Kp"] == pytest.approx(0.7, abs=1e-6)
