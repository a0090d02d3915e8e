"""The motor's numbers from its voltage and angle: exact motion, many motors, another motor, and what is refused."""

import math

import numpy as np
import pytest
from scaling import Units, scaled, scaled_window
from scipy.linalg import expm

from servotwin import Axis, DcMotor, Load, Servo, SquareWave, Transmission, Window, simulate
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.learning.motor import BACK_EMF, BIAS, FRICTION, LearntMotor, MotorLearning, motor_rows
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.estimation.learning.wear import Wear
from servotwin.plant.signals import Array
from servotwin.twin.estimating import motor_learning_of
from servotwin.twin.settings import TwinSettings

PAPER = Servo.preset("paper")
RATE = 5000.0


def learning(servo: Servo = PAPER) -> MotorLearning:
    return MotorLearning(servo, LearningSettings(), 0.058, 0.1)


def turned(servo: Servo, voltage: Array, bias: float = 0.0) -> Window:
    """Window of a motor alone that gets held voltages: by the matrix exponential, apart from all simulation."""
    flow = np.zeros((4, 4))
    flow[:3, :3] = [
        [-servo.R / servo.L, -servo.k_B / servo.L, 0.0],
        [servo.k_T / servo.J, 0.0, 0.0],
        [0.0, 1.0, 0.0],
    ]
    flow[0, 3] = 1.0 / servo.L
    step, state, angles = expm(flow / RATE), np.zeros(3), []
    for volts in voltage:
        angles.append(state[2])
        state = (step @ np.append(state, volts + bias))[:3]
    return Window(np.zeros(voltage.size), theta_m=angles, voltage=voltage, sample_rate=RATE)


def wiggle(seed: int, size: int = 5000) -> Array:
    """Smooth random voltage, both ways."""
    rng, time = np.random.default_rng(seed), np.arange(size) / RATE
    waves = [rng.normal(0.0, 0.3) * np.sin(rng.uniform(5.0, 40.0) * time + rng.uniform(0.0, 6.0)) for _ in range(6)]
    return np.asarray(np.sum(waves, axis=0))


def loop(plant: Servo, friction: float, bias: float, Ki: float = 0.0, seconds: float = 24.0) -> list[Window]:
    """Windows of 1 s of the paper's loop, around and after the steps of a square wave."""
    law = PAPER.controller.replace(Ki=Ki, sample_rate=RATE)
    reference = SquareWave(1e-3, 8.0)
    run = simulate(
        plant,
        seconds,
        controller=law,
        reference=reference,
        gap=math.radians(10.0),
        input_bias=bias,
        friction=friction,
    )
    return [Window.from_run(run, start, 1.0) for start in np.arange(3.8, seconds - 1.5, 4.0)]


def learnt(windows: list[Window], of: MotorLearning | None = None) -> LearntMotor:
    known = None
    for index, window in enumerate(windows):
        known = (of or learning()).updated(known, window, 4.0 * index)
    assert known is not None
    return known


@pytest.mark.parametrize("seed", range(4))
def test_the_equation_holds_for_any_held_voltage(seed: int) -> None:
    plant = PAPER.replace(k_B=0.11, k_T=0.7)
    rows = motor_rows(turned(plant, wiggle(seed), 0.02), PAPER)
    assert rows is not None
    true = np.array([1.1, 0.8 / 0.7, 0.0, 0.02])
    left = rows.voltage - rows.design @ true
    # What is left is the lag's share that the filter's sums of samples miss, and nothing that grows with the motion.
    assert np.max(np.abs(left)) < 2e-5 * np.max(np.abs(rows.voltage))
    assert np.linalg.lstsq(rows.design, rows.voltage, rcond=None)[0] == pytest.approx(true, abs=2e-3)


def test_friction_and_bias_take_two_directions() -> None:
    plant, (bias, friction) = PAPER.replace(k_B=0.93 * PAPER.k_B), (0.05, 0.003)
    windows = loop(plant, friction, bias)
    torque = friction * plant.R / plant.k_T
    one, two = learnt(windows[:1]), learnt(windows[:2])
    # Turning down, only their sum shows.
    assert one.std(FRICTION) > 1.0
    assert one.mean[FRICTION] + one.mean[BIAS] == pytest.approx(torque + bias, abs=1e-4)
    assert two.mean == pytest.approx((-0.07, 0.0, torque, bias), abs=2e-4)
    assert two.friction[0] > 0.9 * torque
    assert two.windows == 2


@pytest.mark.parametrize("limit", [4.0, 2.0])
def test_a_drive_that_cuts_the_commands_is_no_other_motor(limit: float) -> None:
    """Windows hold the law's commands, here up to 7 V; the drive cuts them and the bias together."""
    motor = DcMotor(PAPER.J, PAPER.R, PAPER.k_T, PAPER.k_B, PAPER.L, limit=limit)
    load = Load(tuple(PAPER.masses), tuple(PAPER.stiffnesses), tuple(PAPER.dampings))
    axis = Axis(motor, Transmission(PAPER.p), load, PAPER.controller.replace(sample_rate=RATE))
    of, bias = motor_learning_of(axis, TwinSettings()), 0.05
    run = simulate(axis, 9.0, reference=SquareWave(1e-3, 8.0), gap=math.radians(10.0), input_bias=bias)
    known = learnt([Window.from_run(run, start, 1.0) for start in (3.8, 7.8)], of)
    off = np.abs(np.array(known.mean) - (0.0, 0.0, 0.0, bias))
    assert not known.alarm
    assert np.all(off < 1.96 * np.sqrt(np.diag(known.matrix)))
    assert off[BACK_EMF] < 1e-4
    assert known.windows == 2


def test_intervals_hold_for_many_motors() -> None:
    rng = np.random.default_rng(20261122)
    within, count = np.zeros(4), 24
    for _ in range(count):
        factors = rng.uniform(0.9, 1.1, 2)
        plant = PAPER.replace(
            k_B=PAPER.k_B * factors[0],
            J=PAPER.J * factors[1],
            encoder_resolution=float(rng.choice([0.0, 1e-4, math.radians(0.5)])),
        )
        friction, bias = float(rng.choice([0.0, 0.002])), float(rng.uniform(-0.05, 0.05))
        known = learnt(loop(plant, friction, bias, Ki=float(rng.choice([0.0, 500.0])), seconds=13.0))
        true = np.array([*(factors - 1.0), friction * plant.R / plant.k_T, bias])
        off = np.abs(np.array(known.mean) - true)
        within += off <= 1.96 * np.array([known.std(index) for index in range(4)])
    assert np.all(within >= 0.9 * count), within


def test_noise_of_the_encoder_widens_the_interval_and_does_not_bias() -> None:
    rng = np.random.default_rng(3)
    windows = [turned(PAPER, wiggle(seed)) for seed in range(3)]
    noisy = [w.replace(theta_m=w.theta_m + rng.normal(0.0, 2e-3, w.position.size)) for w in windows]
    assert abs(learnt(noisy).mean[BACK_EMF]) < 0.005
    assert learnt(noisy).std(FRICTION) > learnt(windows).std(FRICTION)


def test_scales_change_nothing() -> None:
    windows = loop(PAPER.replace(k_B=0.95 * PAPER.k_B), 0.0, 0.02, seconds=9.0)
    slow = scaled(PAPER, time=1024.0, voltage=8.0)
    moved = [Window(w.position, theta_m=w.theta_m, voltage=8.0 * w.voltage, sample_rate=RATE / 1024.0) for w in windows]
    one, other = learnt(windows), None
    for index, window in enumerate(moved):
        other = learning(slow).updated(other, window, 4096.0 * index)
    assert other is not None
    assert other.mean[:2] == pytest.approx(one.mean[:2], rel=1e-6, abs=1e-9)
    assert other.mean[2:] == pytest.approx([8.0 * v for v in one.mean[2:]], rel=1e-6, abs=1e-9)


def test_another_motor_is_an_alarm_and_learnt_anew_when_it_stays() -> None:
    own, other = loop(PAPER, 0.0, 0.0), loop(PAPER.replace(k_B=1.2 * PAPER.k_B), 0.0, 0.0)
    known = learnt(own[:3])
    states = [known]
    for index, window in enumerate(other[:3]):
        after = learning().updated(states[-1], window, 12.0 + 4.0 * index)
        assert after is not None
        states.append(after)
    assert [state.surprises for state in states] == [0, 1, 2, 0]
    assert "not the one that was learnt" in states[1].alarm
    assert states[2].mean == known.mean
    assert states[3].mean[BACK_EMF] == pytest.approx(0.2, abs=5e-3)
    assert "learnt anew" in states[3].alarm
    # Two motors under one name: what was learnt stays, and the alarm comes with every window of the other.
    assert learning().current(states[1], 16.0) is None
    later = learning().current(known, 1e6)
    assert later is not None
    assert later.mean == known.mean
    assert all(later.std(index) > known.std(index) for index in range(4))
    back = learning().updated(states[1], own[3], 20.0)
    assert back is not None
    assert (back.surprises, back.alarm) == (0, "")


def test_a_motor_that_is_another_in_every_window_is_said_once_until_a_window_fits() -> None:
    """A motor's angle that comes late looks like that."""
    ways = [loop(PAPER.replace(k_B=factor * PAPER.k_B), 0.0, 0.0) for factor in (1.0, 1.2, 1.4, 0.8)]
    state, said = learnt(ways[0][:3]), list[str]()
    for index, way in enumerate([1, 2, 3, 1, 2, 0, 0, 1]):
        after = learning().updated(state, ways[way][index % 3], 12.0 + 4.0 * index)
        assert after is not None
        state = after
        said.append(state.alarm)
    assert [bool(alarm) for alarm in said] == [True, False, True, *[False] * 4, True]
    assert "learnt anew" in said[2]
    assert "learnt anew" not in said[7]


def test_windows_that_tell_nothing_change_nothing() -> None:
    window, known = turned(PAPER, wiggle(0)), learnt([turned(PAPER, wiggle(1))])
    still = Window(window.position, theta_m=np.zeros(5000), voltage=np.zeros(5000), sample_rate=RATE)
    short = window.slice(0.0, 0.05)
    silent = Window(window.position, theta_m=window.theta_m, sample_rate=RATE)
    elastic = learning(PAPER.replace(k_d=1e6))
    for useless in (still, short, silent):
        assert learning().updated(known, useless, 1.0) is known
    assert elastic.updated(None, window, 0.0) is None


def test_a_load_that_acts_back_is_no_motor_of_this_kind() -> None:
    window = turned(PAPER, wiggle(5))
    assert window.voltage is not None
    other = window.replace(voltage=window.voltage + wiggle(6))
    assert learning().updated(None, other, 0.0) is None


@pytest.mark.parametrize("units", [Units(), Units(2.0**-10, 2.0**20, 2.0**7), Units(1e3, 1e-6, 1e-2)])
def test_a_motor_that_is_always_at_its_drives_limit_teaches_nothing_and_that_is_said(units: Units) -> None:
    """Windows of a drive that cuts nearly every command; a window that tells of the motor ends the count."""
    own = scaled(PAPER, *units)
    motor = DcMotor(own.J, own.R, own.k_T, own.k_B, own.L, limit=2.0 * units.voltage)
    load = Load(tuple(own.masses), tuple(own.stiffnesses), tuple(own.dampings))
    of = motor_learning_of(Axis(motor, Transmission(own.p), load, own.controller), TwinSettings())
    square = 3.0 * np.sign(np.sin(12.0 * np.arange(5000) / RATE))
    cut = turned(PAPER, np.clip(square, -2.0, 2.0))
    always = Window(cut.position, theta_m=cut.theta_m, voltage=square, sample_rate=RATE)
    settings, trends = LearningSettings(), TrendSettings()
    nothing = math.inf, math.inf, (0.0, math.inf)
    estimate = GapEstimate(math.nan, *nothing, GapStatus.UNIDENTIFIABLE, 0.5)
    wear, told = Wear(0.1), list[str]()
    for window in [*[always] * 5, turned(PAPER, wiggle(1)), *[always] * 3]:
        before = wear
        wear, _ = before.update(trends, "b", estimate, 1.0, settings, None, scaled_window(window, units), of)
        told.append("".join(wear.alarms(before, estimate, trends, settings, of)))
    assert [bool(sentence) for sentence in told] == [False, False, True, *[False] * 5, True]
    assert f"the drive's limit of {2.0 * units.voltage:g} V in 100 % of the samples" in told[2]
    assert "tell nothing of the motor" in told[2]
