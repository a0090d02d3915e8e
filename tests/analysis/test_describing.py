"""The describing function against python-control, and its predictions beside the exact orbits."""

import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.analysis.limit_cycles.cycle import limit_cycle
from servotwin.analysis.limit_cycles.describing import limit_cycle_near, play_function, predictions
from servotwin.errors import InvalidInput
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo

GAP = math.radians(10.0)


@given(st.floats(0.01, 2.0), st.floats(0.5001, 1e3))
def test_play_function_against_python_control(gap, multiple):
    """python-control's width b is the total gap."""
    judge = control.friction_backlash_nonlinearity(gap).describing_function(multiple * gap)
    assert play_function(multiple * gap, gap) == pytest.approx(judge, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("multiple", [0.55, 1.0, 3.0])
def test_play_function_is_the_first_harmonic_of_the_play_operator(multiple):
    angle = 2.0 * math.pi * np.arange(80_000) / 20_000
    screw = play(multiple * np.cos(angle), 1.0)[-20_000:]
    harmonic = 2.0 * np.mean(screw * np.exp(-1j * angle[-20_000:]))
    assert harmonic / multiple == pytest.approx(play_function(multiple, 1.0), abs=1e-6)


def test_within_half_the_gap_nothing_moves():
    assert play_function(0.5, 1.0) == 0.0


def test_paper_is_predicted_at_22_26_degrees():
    (found,) = predictions(Servo.preset("paper"), GAP)
    assert math.degrees(found.motor_amplitude) == pytest.approx(22.26, abs=0.005)
    assert found.frequency == pytest.approx(1.4335, abs=5e-5)
    assert found.stable


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "table1"])
@pytest.mark.parametrize("integral", [0.0, 200.0, 18907.6])
@pytest.mark.parametrize("gain", [1.0, 2.6])
def test_all_solutions_and_nothing_else(preset, integral, gain):
    """Every solution balances, and a plane of frequencies and amplitudes holds no other."""
    servo = Servo.preset(preset)
    law = servo.controller
    law = law.replace(Ki=integral, Kp=gain * law.Kp, Kd=gain * law.Kd)
    found, loop = predictions(servo, GAP, law), servo.loop(law)
    for one in found:
        balance = play_function(one.motor_amplitude, GAP) * loop.response(2.0 * math.pi * one.frequency)
        assert balance == pytest.approx(-1.0, abs=1e-9)
    omega = np.logspace(-2, 2.3, 4001)
    angles = np.linspace(0.05, math.pi - 0.05, 200)
    amplitudes = GAP / (1.0 - np.cos(angles))
    plane = 1.0 + np.outer([play_function(a, GAP) for a in amplitudes], loop.response(omega))
    cells = _changes(plane.real) & _changes(plane.imag)
    near = {float(np.sqrt(omega[k] * omega[k + 1])) / (2.0 * math.pi) for k in np.flatnonzero(cells.any(axis=0))}
    assert all(min((abs(math.log(f / one.frequency)) for one in found), default=9.0) < 0.05 for f in near)


def _changes(values):
    """Cells at whose corners both signs occur."""
    corners = np.stack([values[:-1, :-1], values[1:, :-1], values[:-1, 1:], values[1:, 1:]]) > 0.0
    return corners.any(axis=0) & ~corners.all(axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "table1", "paper-gain2"])
def test_shooting_from_the_prediction_gives_the_orbit_of_the_run(preset):
    servo = Servo.preset(preset)
    (prediction,) = predictions(servo, GAP)
    near, run = limit_cycle_near(servo, GAP, prediction).orbit, limit_cycle(servo, GAP).orbit
    assert near is not None
    assert run is not None
    assert near.frequency == pytest.approx(run.frequency, rel=1e-11)
    assert near.amplitude == pytest.approx(run.amplitude, rel=1e-10)
    assert prediction.frequency == pytest.approx(run.frequency, rel=0.05)


def test_an_unstable_cycle_divides_runs_that_settle_from_runs_that_do_not():
    """High gain, no integral: small motions the gap calms, large ones the unstable linear loop drives away."""
    servo = Servo.preset("paper")
    law = servo.controller.replace(Ki=0.0, Kp=2.8 * servo.controller.Kp, Kd=2.8 * servo.controller.Kd)
    (prediction,) = predictions(servo, GAP, law)
    found = limit_cycle_near(servo, GAP, prediction, law).orbit
    assert found is not None
    assert not prediction.stable
    assert not found.stable
    assert found.motor_amplitude == pytest.approx(prediction.motor_amplitude, rel=2e-3)
    for factor in (0.999, 1.001):
        start = found.start.copy()
        moving = np.array([name not in ("reference", "gap", "tolerance") for name in found.loop.automaton.names])
        start[moving] *= factor
        run = Trajectory(found.loop.automaton, start, found.start_mode, found.period / 64)
        run.advance(64 * 40)
        late = run.sampled(found.loop.rows["position"], 64 * 38)
        assert bool(0.5 * np.ptp(late) > found.amplitude) is (factor > 1.0)


def test_a_loop_filter_is_part_of_the_loop():
    servo = Servo.preset("paper").replace(loop_filter_hz=20.0)
    (prediction,) = predictions(servo, GAP)
    near, run = limit_cycle_near(servo, GAP, prediction).orbit, limit_cycle(servo, GAP).orbit
    assert near is not None
    assert run is not None
    assert near.frequency == pytest.approx(run.frequency, rel=1e-11)


@pytest.mark.parametrize(
    ("changes", "gap", "message"),
    [
        ({"k_d": 1e7}, GAP, "k_d"),
        ({"voltage_limit": 5.0}, GAP, "voltage_limit_v = 5 V"),
        ({"sample_rate": 100.0}, GAP, "sample_rate = 100 Hz"),
        ({}, 0.0, "gap = 0.0 rad"),
    ],
)
def test_loops_without_a_describing_function_are_refused(changes, gap, message):
    with pytest.raises(InvalidInput, match=message):
        predictions(Servo.preset("paper").replace(**changes), gap)
