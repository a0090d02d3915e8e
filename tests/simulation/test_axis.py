"""Axes of every actuator and transmission against scipy's integrator, written anew from the equations."""

import math

import numpy as np
import pytest
from axis_oracle import positions
from exploration import explored
from law_oracle import IDLE, ContinuousOracle, continuous_positions

from benchmarks.random_axes import random_axis, step_window
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import DcMotor, Stepper, TorqueDrive, VelocityDrive
from servotwin.plant.axis import AXES as PRESETS
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

SCREW = Transmission(1e-3 / math.pi)
TWO_MASS = Axis(
    TorqueDrive(J=0.4, lag=1e-3, friction=0.05),
    Transmission(p=1.0, k_d=3300.0, c_d=2.0, in_gap="free"),
    Load((5.6,), (0.0,), (0.3,), "rotary"),
    Controller(Kp=60.0, Ki=20.0, Kd=40.0, Tf=0.01),
)
UNDAMPED = Transmission(p=0.5, k_d=330.0, in_gap="free")
SOFT = Controller(Kp=4.0, Ki=0.2, Kd=3.0, Tf=0.05)
PAPER = Servo.preset("paper")
ON_SCREW = Load((5.2,) * 3, (1e4,) * 3, (36.9,) * 3)
ELASTIC = Transmission(1e-3 / math.pi, 1e5, 150.0, "free")


def undamped(stiffness: float) -> Axis:
    """Two masses on a shaft without damping, the second free or on the ground."""
    load, sensors = Load((5.6,), (stiffness,), (9.0,), "rotary"), Sensors(feedback="motor")
    return TWO_MASS.replace(transmission=UNDAMPED, controller=SOFT, load=load, sensors=sensors)


OTHERS = ("two masses", "undamped shaft", "velocity drive, one mass")
"""Axes of which another one has every part: for `make fuzz`."""
HALF = 1.5  # s, half a period
# Axis, amplitude (m or rad) and gap (rad).
AXES = {
    "two masses": (TWO_MASS, 0.2, 0.03),
    "two masses, motor's encoder": (TWO_MASS.replace(sensors=Sensors(feedback="motor")), 0.2, 0.03),
    "undamped shaft": (undamped(0.0), 0.2, 0.1),
    "undamped shaft, load on the ground": (undamped(2.0), 0.2, 0.1),
    "free in the gap, two masses of load": (
        TWO_MASS.replace(load=Load((3.0, 2.6), (0.0, 9e4), (0.3, 90.0), "rotary"), controller=SOFT),
        0.2,
        0.03,
    ),
    "friction of motor and load, gravity": (
        TWO_MASS.replace(
            actuator=TorqueDrive(J=0.4, lag=1e-3, friction=0.05, coulomb=0.2),
            load=Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.8, force=-0.3),
            controller=SOFT,
        ),
        0.2,
        0.03,
    ),
    "friction of the second mass": (
        Axis(
            DcMotor(5e-6, 12.0, 0.8, 0.1, 1e-3, coulomb=0.01),
            SCREW,
            Load((5.2,) * 2, (1e4,) * 2, (36.9,) * 2, friction=3.0, force=1.0),
            Controller(300.0, 900.0, 0.0, 0.1),
        ),
        1e-3,
        0.3,
    ),
    "friction that falls with the speed": (
        TWO_MASS.replace(
            actuator=TorqueDrive(J=0.4, lag=1e-3, friction=0.05, coulomb=0.2, static=0.5, stribeck=0.03),
            load=Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.6, static=0.9, stribeck=0.02),
            controller=SOFT,
        ),
        0.2,
        0.03,
    ),
    "friction that falls, of a motor on a screw": (
        Axis(
            DcMotor(5e-6, 12.0, 0.8, 0.1, 1e-3, coulomb=0.01, static=0.015, stribeck=2.0),
            SCREW,
            ON_SCREW,
            Controller(300.0, 900.0, 0.0, 0.1),
        ),
        1e-3,
        0.3,
    ),
    "drive with a limit": (
        TWO_MASS.replace(actuator=TorqueDrive(J=0.4, lag=1e-3, friction=0.05, limit=2.5)),
        0.2,
        0.03,
    ),
    "velocity drive with a limit": (
        Axis(VelocityDrive(5e-3, limit=12.0), SCREW, Load((20.0,)), Controller(3e4, 1e4, 0.0, 0.1)),
        1e-3,
        0.3,
    ),
    "a load that hangs": (
        TWO_MASS.replace(load=Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.4, force=-2.0), controller=SOFT),
        0.2,
        0.03,
    ),
    "DC motor without inductance": (
        Axis(DcMotor(5e-6, 12.0, 0.8, 0.1), SCREW, ON_SCREW, PAPER.controller),
        1e-3,
        0.3,
    ),
    "DC motor, elastic shaft": (
        Axis(
            DcMotor(5e-6, 12.0, 0.8, 0.1, 1e-3, 1e-4),
            ELASTIC,
            Load((5.2,) * 2, (0.0, 1e4), (9.0, 36.9)),
            Controller(300.0, 900.0, 0.0, 0.1),
        ),
        1e-3,
        0.3,
    ),
    "velocity drive, one mass": (
        Axis(VelocityDrive(5e-3), SCREW, Load((20.0,)), Controller(3e4, 1e4, 0.0, 0.1)),
        1e-3,
        0.3,
    ),
    "stepper": (
        Axis(Stepper(2e-2), SCREW, Load((5.2, 5.2), (0.0, 1e4), (0.0, 36.9)), Controller(200.0, 1e4, 0.0, 0.1)),
        1e-3,
        0.3,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", explored(AXES, *(k for k, name in enumerate(AXES) if name not in OTHERS)))
def test_an_axis_agrees_with_an_independent_integrator(name: str) -> None:
    axis, amplitude, gap = AXES[name]
    axis.check_loop()
    run = simulate(axis, 2.0 * HALF, reference=SquareWave(amplitude, 2.0 * HALF), gap=gap, sample_rate=100.0)
    expected, changes = positions(axis, gap, amplitude, HALF, run.time[:-1])
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * amplitude
    events = run.events[np.isin(run.events.kind, ("contact", "release"))].time
    assert len(changes) >= 3
    assert events == pytest.approx(changes, abs=1e-6)


# Half period (s), amplitude (m or rad) and gap (rad) of each preset: about a healthy gap.
MOTIONS = {
    "two-mass-drive": (1.0, 0.2, 0.02),
    "ball-screw": (0.1, 1e-3, 6.3e-3),
    "robot-joint": (0.4, 0.02, 0.092),
    "telescope": (4.0, 1e-3, 0.098),
    "stepper-stage": (1.0, 1e-4, 0.0126),
    "micro-positioner": (0.15, 1e-5, 0.16),
    "gantry": (0.8, 5e-3, 0.02),
    "emps": (0.5, 1e-2, 0.063),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MOTIONS)
def test_a_preset_agrees_with_an_independent_integrator(name: str) -> None:
    """With a continuous law without limit, and ideal encoders: the oracle has neither."""
    half_period, amplitude, gap = MOTIONS[name]
    axis = Axis.preset(name)
    ideal = Sensors(feedback=axis.sensors.feedback)
    axis = axis.replace(sample_rate=None, voltage_limit=None, sensors=ideal)
    reference = SquareWave(amplitude, 2.0 * half_period)
    run = simulate(axis, 2.0 * half_period, reference=reference, gap=gap, sample_rate=100.0)
    if isinstance(axis.controller, Cascade):
        oracle = ContinuousOracle(axis.replace(controller=IDLE), gap, law=axis.controller.linear())
        expected, changes = continuous_positions(oracle, amplitude, half_period, run.time[:-1]), oracle.changes
    else:
        expected, changes = positions(axis, gap, amplitude, half_period, run.time[:-1])
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * amplitude
    assert len(changes) >= 3


def test_every_preset_is_measured_against_something() -> None:
    assert set(MOTIONS) == set(PRESETS)


def test_the_published_axis_follows_a_ramp_as_its_published_numbers_say() -> None:
    """A cascade without integral action lags by the speed and by what the friction takes."""
    axis, speed = Axis.preset("emps"), 0.05
    ramp = PiecewiseCubic(np.array([0.0]), np.array([[0.0, speed, 0.0, 0.0]]))
    run = simulate(axis, 2.0, reference=ramp, sample_rate=1000.0)
    lag = speed / 160.18 + (203.5034 * speed + 20.3935) / (243.45 * 35.15065 * 160.18)
    assert (run.reference - run.position)[-1] == pytest.approx(lag, rel=1e-3)


@pytest.mark.parametrize("name", AXES)
def test_a_sampled_law_tends_to_the_continuous_one(name: str) -> None:
    axis, amplitude, gap = AXES[name]

    def position(law: Controller) -> np.ndarray:
        run = simulate(axis, 2.0, controller=law, reference=SquareWave(amplitude, 8.0), gap=gap, sample_rate=100.0)
        return run.position

    exact = position(axis.controller)
    errors = [np.abs(position(axis.controller.replace(sample_rate=rate)) - exact).max() for rate in (2e4, 1e5)]
    assert errors[1] < 0.3 * errors[0] < 0.02 * amplitude


@pytest.mark.parametrize("name", AXES)
def test_polynomials_and_states_are_one_system(name: str) -> None:
    plant, omega = AXES[name][0].plant(), np.geomspace(0.1, 300.0, 40)
    by_states = plant._response_of_states(1j * omega)
    assert plant.response(omega) == pytest.approx(by_states, rel=1e-7)


def test_the_paper_s_servo_is_one_combination() -> None:
    """Bit for bit: its automaton has the same numbers."""
    parts = Axis(
        DcMotor(PAPER.J, PAPER.R, PAPER.k_T, PAPER.k_B, PAPER.L),
        Transmission(PAPER.p),
        Load(tuple(PAPER.masses), tuple(PAPER.stiffnesses), tuple(PAPER.dampings)),
        PAPER.controller,
    )
    runs = [simulate(each, 20.0, reference=1e-3, gap=0.2, tolerance=1e-5) for each in (PAPER, parts)]
    assert np.array_equal(runs[0].position, runs[1].position)
    assert np.array_equal(runs[0].events, runs[1].events)
    assert parts.margins() == PAPER.margins()


def test_integral_action_swings_in_the_gap_and_rests_without() -> None:
    """The limit cycle of two inertias, which a driven end that is held in the gap hides."""
    axis = TWO_MASS.replace(
        actuator=TorqueDrive(0.4, 1e-3, 2.0),
        transmission=Transmission(1.0, 3300.0, in_gap="free"),
        load=Load((5.6,), (0.0,), (6.0,), "rotary"),
        controller=Controller(20.0, 10.0, 20.0, 0.02),
    )
    swings = [
        np.ptp(simulate(axis, 60.0, reference=0.1, gap=gap, sample_rate=200.0).position[-4000:])
        for gap in (0.0, math.radians(0.1), math.radians(0.2))
    ]
    assert swings[0] < 1e-6
    assert swings[2] > 1e-4
    # A limit cycle is as large as the gap.
    assert swings[2] == pytest.approx(2.0 * swings[1], rel=0.02)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Transmission(0.0), "transmission p = 0.0: must be positive and finite"),
        (lambda: Transmission(1.0, in_gap="free"), "needs a finite stiffness"),
        (lambda: Transmission(1.0, c_d=1.0), "needs a finite k_d; a rigid transmission has none"),
        (lambda: Load((-1.0,)), r"load m\[0\] \(mass_kg\) = -1.0 kg: must be finite and positive"),
        (
            lambda: Load((1.0, 2.0), (0.0, 0.0), (0.0, 0.0)),
            r"load k\[1\] \(stiffness_n_per_m\) = 0.0 N/m: must be finite and positive",
        ),
        (lambda: Load((1.0, 2.0)), "must have one value for each of the 2 masses"),
        (lambda: TorqueDrive(J=0.0), "actuator J = 0.0 kg m\\^2"),
        (lambda: Sensors(feedback="screw"), "sensors feedback = 'screw': must be one of load, motor"),
        (lambda: TWO_MASS.replace(gearbox=1), "axis has no part or gain named 'gearbox'"),
        (lambda: TWO_MASS.replace(load=None), "axis load = None: must be a Load"),
        (lambda: TWO_MASS.check_loop(Controller(-60.0, 0.0, 0.0, 0.1)), "unstable on this axis"),
    ],
)
def test_refusals_are_one_sentence(make: object, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make()  # type: ignore[operator]


def test_a_shaft_without_damping_closes_its_gap_without_a_pull() -> None:
    """In the gap its load-side end was a state of its own: 1e-12 off the load after 10 000 samples, it touched the
    flank under a pull, which let go, and touched again at the same instant, without end."""
    drawn = random_axis("dc motor", 9191, 24)
    assert drawn.plant.transmission.c_d == 0.0
    assert np.all(np.isfinite(step_window(drawn, 2).position))


def test_the_twist_that_a_damped_shaft_keeps_at_release_fades_in_the_gap() -> None:
    """With damping over stiffness, in closed form, behind every release."""
    shaft, gap = Transmission(p=1.0, k_d=3300.0, c_d=12.0, in_gap="free"), 0.03
    run = simulate(TWO_MASS.replace(transmission=shaft), 1.5, reference=0.2, gap=gap, sample_rate=4000.0)
    twist = shaft.p * run.theta_d - run.q[:, 0]
    open_ = np.abs(run.theta_m - run.theta_d) < 0.5 * gap * (1.0 - 1e-9)
    left = twist[1:] - twist[:-1] * math.exp(-shaft.k_d / shaft.c_d / 4000.0)
    both, size = open_[1:] & open_[:-1], np.abs(twist).max()
    assert np.abs(left[both]).max() < 1e-9 * size
    assert np.abs(twist[1:][both]).max() > 0.1 * size


def test_without_a_rate_every_preset_is_recorded_at_one_that_its_controller_allows() -> None:
    rates = {name: simulate(Axis.preset(name), 0.01).sample_rate for name in PRESETS}
    assert rates["two-mass-drive"] == 2000.0
    assert rates["micro-positioner"] == 5000.0
    for rate in (400.0, 500.0, 12500.0, 20000.0):
        run = simulate(PAPER.replace(controller=PAPER.controller.replace(sample_rate=rate)), 0.1)
        assert run.sample_rate == (12500.0 if rate == 12500.0 else 400.0 if rate == 400.0 else 5000.0)


@pytest.mark.parametrize("part", [DcMotor(J=1e-7, R=10.0, k_T=0.01, k_B=0.01, L=1e-11), TorqueDrive(J=1e-7, lag=1e-12)])
@pytest.mark.parametrize("rate", [None, 5000.0])
def test_a_motion_that_is_far_too_fast_for_the_samples_is_refused(part: DcMotor | TorqueDrive, rate: float) -> None:
    axis = TWO_MASS.replace(actuator=part, controller=SOFT.replace(sample_rate=rate))
    with pytest.raises(InvalidInput, match=r"a time constant of 1e-12 s, too short for samples every 0\.0002 s"):
        simulate(axis, 0.01, reference=0.1)
