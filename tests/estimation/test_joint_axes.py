"""Joint estimates of axes made of parts: held by the gap, free in it, one mass; and the windows that are refused."""

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.joint.axis import WIDE
from servotwin.estimation.joint.settings import JointSettings
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

PAPER = Servo.preset("paper")
PARTS = Axis(
    st.DcMotor(PAPER.J, PAPER.R, PAPER.k_T, PAPER.k_B, PAPER.L),
    st.Transmission(PAPER.p),
    st.Load(tuple(PAPER.masses), tuple(PAPER.stiffnesses), tuple(PAPER.dampings)),
    PAPER.controller,
)
BALL_SCREW, GAP = Axis.preset("ball-screw"), 5e-6 / Axis.preset("ball-screw").p


@lru_cache
def ball_screw(stiffness: float = 1.0, friction: float = 1.0, worn: float = 4.0) -> Window:
    """A step and a half of a machine whose shaft and guide are not as stated."""
    shaft = BALL_SCREW.transmission
    machine = BALL_SCREW.scaled({"load_friction": friction}).replace(
        transmission=dataclasses.replace(shaft, k_d=stiffness * shaft.k_d)
    )
    run = simulate(machine, 1.0, reference=SquareWave(3e-4, 0.8), gap=worn * GAP, sample_rate=2000.0)
    return Window.from_run(run, 0.38, 0.4)


@lru_cache
def paper_window(gap: float = 0.2, sample_rate: float = 1000.0) -> Window:
    run = simulate(PAPER, 8.0, reference=SquareWave(1e-3, 10.0), gap=gap, sample_rate=sample_rate)
    return Window.from_run(run, 4.7, 2.0)


def test_the_paper_s_servo_made_of_parts_has_the_same_estimate() -> None:
    wrong = {"k": 1.05, "c": 1.2, "p": 1.01}
    ours = st.estimate_jointly(paper_window(), PARTS.scaled(wrong))
    theirs = st.estimate_jointly(
        paper_window(), PAPER.replace(**{name: factor * getattr(PAPER, name) for name, factor in wrong.items()})
    )
    assert (ours.gap.gap, ours.gap.std) == pytest.approx((theirs.gap.gap, theirs.gap.std), rel=1e-6)
    for name, one in theirs.parameters.items():
        own = ours.parameters[name]
        assert (own.value, own.std) == pytest.approx((one.value, one.std), rel=1e-5, abs=1e-9)
    assert ours.gap.model_version == PARTS.scaled(wrong).version
    found = ours.servo
    assert isinstance(found, Axis)
    assert found.p == pytest.approx(PARTS.p, rel=1e-4)
    assert found.load.k == pytest.approx(PARTS.load.k, rel=1e-3)


@pytest.mark.parametrize("motor_encoder", [True, False])
def test_an_axis_s_angle_is_computed_from_the_voltage_of_the_paper_s_motor(motor_encoder: bool) -> None:
    seen = paper_window(sample_rate=5000.0)
    window = Window(seen.position, voltage=seen.voltage, sample_rate=5000.0)
    axis = PARTS.replace(sensors=dataclasses.replace(PARTS.sensors, motor_encoder=motor_encoder))
    found = st.estimate_jointly(window, axis.scaled({"k_B": 1.02}), free=("k_B",))
    assert found.gap.ok, found.gap.reasons
    assert found.gap.gap == pytest.approx(0.2, abs=1e-3)
    assert isinstance(found.servo, Axis)
    assert found.servo.actuator.k_B == pytest.approx(PAPER.k_B, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_the_spreads_of_numbers_contain_what_counts_and_their_noise_do(noise: float) -> None:
    count, random, away = 2.0 * math.pi / 2000.0, np.random.default_rng(4), []
    axis = PARTS.replace(sensors=st.Sensors(encoder_resolution=count))
    for gap in np.linspace(0.15, 0.25, 8):
        seen = paper_window(float(gap))
        angle = count * np.round(seen.theta_m / count + noise * random.standard_normal(seen.samples))
        found = st.estimate_jointly(Window(seen.position, angle, sample_rate=1000.0), axis)
        assert found.gap.ok, found.gap.reasons
        assert found.gap.interval[0] < gap < found.gap.interval[1]
        away.append(
            [(one.factor - 1.0) / (one.std / one.value) for one in map(found.parameters.get, ("k/m", "c/m", "pitch"))]
        )
    assert np.abs(away).max() < 4.0
    assert np.all(np.sqrt(np.mean(np.square(away), axis=0)) < 2.0)


@pytest.mark.slow
def test_a_free_shaft_s_numbers_are_found_where_the_gap_s_own_fit_refuses_them() -> None:
    window, gap = ball_screw(stiffness=1.5, friction=1.3), 4.0 * GAP
    refused = st.estimate_gap(window, BALL_SCREW)
    assert refused.status is GapStatus.MODEL_MISMATCH
    found = st.estimate_jointly(window, BALL_SCREW)
    assert found.gap.ok, found.gap.reasons
    assert found.gap.gap == pytest.approx(gap, rel=0.01)
    assert found.gap.interval[0] < gap < found.gap.interval[1]
    for name, factor in {"shaft stiffness": 1.5, "load friction": 1.3, "ratio": 1.0}.items():
        one = found.parameters[name]
        assert abs(one.factor - factor) <= 4.0 * one.factor * one.std / one.value
    assert isinstance(found.servo, Axis)
    assert found.servo.transmission.k_d == pytest.approx(1.5 * BALL_SCREW.transmission.k_d, rel=0.01)
    assert found.servo.load.friction == pytest.approx(1.3 * BALL_SCREW.load.friction, rel=0.05)
    assert found.covariance.shape == (len(found.names), len(found.names))
    assert math.sqrt(found.covariance[0, 0]) == pytest.approx(found.gap.std)


@pytest.mark.slow
def test_an_axis_with_the_fitted_numbers_needs_no_other_ones() -> None:
    window = ball_screw(stiffness=0.7)
    first = st.estimate_jointly(window, BALL_SCREW)
    assert isinstance(first.servo, Axis)
    again = st.estimate_jointly(window, first.servo)
    assert again.gap.gap == pytest.approx(first.gap.gap, rel=2e-3)
    for name in ("shaft stiffness", "ratio", "load friction"):
        assert again.parameters[name].factor == pytest.approx(1.0, abs=3e-3)


@pytest.mark.slow
def test_the_settings_of_a_free_shaft_s_fit_say_what_is_known() -> None:
    narrow = dataclasses.replace(WIDE, stiffness=0.05)
    found = st.estimate_jointly(ball_screw(stiffness=1.5), BALL_SCREW, settings=narrow)
    assert found.gap.status is GapStatus.MODEL_MISMATCH
    assert "stiffness" in found.gap.reasons[0]


@pytest.mark.slow
def test_windows_of_one_free_shaft_agree() -> None:
    found = st.estimate_jointly([ball_screw(), ball_screw(worn=8.0)], BALL_SCREW)
    assert [gap.gap / GAP for gap in found.gaps] == pytest.approx([4.0, 8.0], rel=0.01)


@pytest.mark.slow
def test_windows_of_two_shafts_contradict() -> None:
    found = st.estimate_jointly([ball_screw(), ball_screw(stiffness=0.8)], BALL_SCREW)
    assert all(gap.status is GapStatus.MODEL_MISMATCH for gap in found.gaps)
    assert "fitted with what another window tells of the machine, " in found.gap.reasons[0]


@pytest.mark.slow
def test_a_window_without_information_does_not_disturb_the_others() -> None:
    good = ball_screw()
    still = Window(np.zeros(800), np.zeros(800), sample_rate=2000.0)
    found = st.estimate_jointly([good, still], BALL_SCREW)
    assert found.gaps[0] == st.estimate_jointly(good, BALL_SCREW).gap
    assert found.gap.status is GapStatus.UNIDENTIFIABLE
    nothing = st.estimate_jointly(still, BALL_SCREW)
    assert (nothing.parameters, nothing.names, nothing.servo) == ({}, ("gap",), BALL_SCREW)
    assert "constant" in nothing.gap.reasons[0]


def stage(places: list[float], worn: float) -> Window:
    """A screw of one mass under a motor that goes to places, mm of the table, in half a second each; 100 Hz."""
    axis, rate = Axis.preset("stepper-stage"), 200.0
    time = np.arange(round(0.5 * len(places) * rate)) / rate
    goals = np.array([0.0, *places])
    at = np.minimum((time / 0.5).astype(int), len(places) - 1)
    way = np.clip((time - 0.5 * at) / 0.4, 0.0, 1.0)
    motor = goals[at] + (goals[at + 1] - goals[at]) * (10.0 - 15.0 * way + 6.0 * way**2) * way**3
    theta_m = 1e-3 * motor / axis.p
    position = 1.002 * axis.p * play(theta_m, worn, theta_m[0])
    counts = axis.sensors
    return Window(
        counts.position_resolution * np.round(position / counts.position_resolution),
        counts.encoder_resolution * np.round(theta_m / counts.encoder_resolution),
        sample_rate=rate,
    )


@pytest.mark.slow
def test_moves_of_different_lengths_tell_the_ratio_to_a_window_of_equal_ones() -> None:
    axis, gap = Axis.preset("stepper-stage"), 0.05
    different, equal = stage([0.2, -0.3, 0.6, -0.1, 0.9, 0.0], gap), stage([0.4, 0.0, 0.4, 0.0, 0.4, 0.0], gap)
    alone, found = st.estimate_jointly(equal, axis), st.estimate_jointly([different, equal], axis)
    assert [one.gap for one in found.gaps] == pytest.approx([gap, gap], rel=0.05)
    assert all(one.ok and one.interval[0] < gap < one.interval[1] for one in found.gaps)
    assert found.gap.std < alone.gap.std
    ratio = found.parameters["ratio"]
    assert ratio.factor == pytest.approx(1.002, abs=5e-4)
    assert ratio.std < 0.7 * alone.parameters["ratio"].std
    assert isinstance(found.servo, Axis)
    assert found.servo.p == pytest.approx(1.002 * axis.p, rel=5e-4)


@pytest.mark.slow
def test_friction_of_a_load_that_the_gap_holds_is_found_and_its_windows_are_fitted_one_at_a_time() -> None:
    load = st.Load(tuple(PAPER.masses), (0.0, *PAPER.stiffnesses[1:]), tuple(PAPER.dampings), friction=0.05)
    axis = PARTS.replace(load=load)
    run = simulate(
        axis.scaled({"load_friction": 1.3, "k": 1.2}), 8.0, reference=SquareWave(1e-3, 10.0), gap=0.2, sample_rate=1e3
    )
    window = Window.from_run(run, 4.7, 2.0)
    found = st.estimate_jointly(window, axis)
    assert found.gap.ok, found.gap.reasons
    assert found.gap.interval[0] < 0.2 < found.gap.interval[1]
    assert found.parameters["load friction"].factor == pytest.approx(1.3, rel=0.03)
    assert isinstance(found.servo, Axis)
    assert found.servo.load.k[1:] == pytest.approx([1.2 * k for k in load.k[1:]], rel=0.01)
    with pytest.raises(InvalidInput, match="fits one window of such an axis at a time"):
        st.estimate_jointly([window, window], axis)


def without(window: Window, *names: str) -> Window:
    kept = {name: values for name, values in window.channels.items() if name not in names}
    return Window(**kept, sample_rate=window.sample_rate)


VELOCITY = Axis(
    st.VelocityDrive(5e-3),
    st.Transmission(1e-3 / math.pi),
    st.Load((5.0, 5.0), (0.0, 1e4), (0.0, 37.0)),
    PAPER.controller,
)


@pytest.mark.parametrize(
    ("window", "axis", "options", "words"),
    [
        (ball_screw, BALL_SCREW, {"free": ("k/m",)}, "has all of its numbers free"),
        (ball_screw, BALL_SCREW, {"settings": JointSettings()}, "give OutputErrorSettings"),
        (ball_screw, BALL_SCREW, {"prior": -0.1}, "must be finite and at least 0"),
        (lambda: without(ball_screw(), "position"), BALL_SCREW, {}, "has no position: the joint estimator needs"),
        (lambda: without(ball_screw(), "theta_m"), BALL_SCREW, {}, "no theta_m"),
        (lambda: [ball_screw(), without(ball_screw(), "theta_m")], BALL_SCREW, {}, "must be alike"),
        (list, BALL_SCREW, {}, "no window"),
        (lambda: ball_screw().slice(0.38, 0.1), BALL_SCREW, {}, "at least 400"),
        (lambda: without(paper_window(), "theta_m"), VELOCITY, {}, "a DC motor with inductance and without friction"),
        (paper_window, PARTS, {"settings": OutputErrorSettings()}, "give JointSettings"),
        (paper_window, PAPER, {"settings": OutputErrorSettings()}, "give JointSettings"),
        (paper_window, PARTS, {"free": ("k_B",)}, "k_B cannot be free"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_sentence(window, axis, options, words) -> None:
    with pytest.raises(InvalidInput, match=words) as error:
        st.estimate_jointly(window(), axis, **options)
    assert "\n" not in str(error.value)


def test_the_motor_s_own_position_is_not_the_load_s() -> None:
    axis = Axis.preset("emps")
    theta_m = np.sin(np.linspace(0.0, 20.0, 2000))
    with pytest.raises(InvalidInput, match="the motor's own position, and no other"):
        st.estimate_jointly(Window(axis.p * theta_m, theta_m, sample_rate=1000.0), axis)
