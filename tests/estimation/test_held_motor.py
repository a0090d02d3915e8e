"""Gaps behind an elastic screw that the gap holds, from the motor's encoder and the command alone."""

import dataclasses
import math

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation import motor_side
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.motor_side.held_motion import HeldShaft
from servotwin.estimation.motor_side.problem import MotorModel, MotorProblem
from servotwin.estimation.output_error.models import HALF, Priors
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Actuator, DcMotor, TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.plants import check_gap_in_loop
from servotwin.plant.sensors import Sensors
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Run, simulate
from servotwin.twin.estimating import estimator_of
from servotwin.twin.quick_fits import Known, quick_fits_of
from servotwin.twin.settings import TwinSettings

RATE, INERTIA, PITCH, GAP = 1000.0, 1e-4, 1e-3, 0.3
BEGIN, LENGTH, SWING = 0.9, 0.8, 2.0 * math.pi * 30.0
COUNT = 1e-4


def held_axis(
    masses: int = 1, ground: float = 0.0, friction: float = 0.0, motor: Actuator | None = None, heavy: float = 2.0
) -> Axis:
    """Masses that swing at about 30 Hz behind the screw, `heavy` times the motor's inertia, on a spring to the ground
    (of the screw's stiffness), with friction (N), and a loop of about 2 Hz on the motor's encoder."""
    mass = heavy * INERTIA / PITCH**2
    stiffness, crossover = mass * SWING**2, 4.0 * math.pi
    load = Load(
        (mass / masses,) * masses,
        (ground * stiffness, *(masses - 1) * (2.0 * stiffness,)),
        (3.0 * mass, *(masses - 1) * (0.1 * mass * SWING,)),
        friction=friction,
    )
    gain = INERTIA * (1.0 + heavy) * crossover**2 / PITCH
    law = Controller(gain, gain * crossover / 6.0, 1.35 * gain / crossover, 0.1 / crossover, sample_rate=RATE)
    drive = motor or TorqueDrive(INERTIA, 4e-4, 1e-4)
    return Axis(drive, Transmission(PITCH, stiffness), load, law, Sensors(COUNT, feedback="motor"))


RUBBING = TorqueDrive(INERTIA, 4e-4, 1e-4, coulomb=0.02)
AXES = {
    "one mass": held_axis(),
    "two masses": held_axis(2),
    "on a spring": held_axis(ground=0.1),
    "friction": held_axis(2, friction=20.0, motor=RUBBING),
    "DC motor": held_axis(motor=DcMotor(INERTIA, 1.0, 0.02, 0.02, 2e-4)),
}


def swung(axis: Axis, gap: float = GAP) -> Run:
    """A sine of 1 Hz, thirteen gaps wide."""
    time = np.arange(2000) / RATE
    sine = Samples(time, 2e-3 * np.sin(2.0 * math.pi * time))
    return simulate(axis, BEGIN + LENGTH + 0.1, reference=sine, gap=gap, sample_rate=RATE)


def at_motor(run: Run) -> Window:
    """Most of a period, without the load's position."""
    seen = Window.from_run(run, BEGIN, LENGTH)
    return Window(theta_m=seen.theta_m, voltage=seen.voltage, sample_rate=RATE, start=BEGIN)


def model_of(axis: Axis) -> MotorModel:
    return MotorModel(axis, HeldShaft(axis, Priors(0.1, 0.1, 0.1, 0.1, 1e-3), 0.2), 0.1, 0.1, 0.1, 1e-4)


def true_start(problem: MotorProblem, run: Run) -> np.ndarray:
    """The machine's own numbers and first state."""
    values, names = problem.start(0.5 * PITCH * GAP, 0.0), [each.name for each in problem.model.unknowns]
    first, n = round(BEGIN * RATE), problem.model.axis.n
    at = names.index("first place")
    values[at] = PITCH * run.theta_d[first]
    values[at + 1 : at + 1 + n] = run.q[first]
    values[at + 1 + n : at + 1 + 2 * n] = 0.5 * RATE * (run.q[first + 1] - run.q[first - 1])
    speed = 0.5 * RATE * PITCH * (run.theta_m[first + 1] - run.theta_m[first - 1])
    values[-1] = speed - problem.first_speed()
    return values


@pytest.mark.parametrize("name", AXES)
def test_a_model_with_the_true_numbers_predicts_the_motor_best(name: str) -> None:
    """Of the exact simulation, which locates contacts, rests and slips as events: to a thousandth of the gap."""
    axis = AXES[name]
    run = swung(axis)
    window = at_motor(run)
    assert window.theta_m is not None
    assert window.voltage is not None
    begin = round(BEGIN * RATE)
    exact = PITCH * run.theta_m[begin : begin + window.samples]
    problem = MotorProblem(model_of(axis), exact, window.voltage, 1.0 / RATE, PITCH * COUNT)
    values = true_start(problem, run)

    def left(factor: float) -> float:
        changed = values.copy()
        changed[HALF] *= factor
        return float(np.std(problem.misfit(changed, problem.model.speed))) / (PITCH * GAP)

    assert left(1.0) < 1e-3
    assert left(0.97) > 3.0 * left(1.0)
    assert left(0.0) > 30.0 * left(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_the_gap_is_right_and_inside_its_interval(name: str) -> None:
    """Of a machine whose screw is softer, whose motor is stronger and whose load is less damped than in the model."""
    axis = AXES[name]
    machine = axis.scaled({"k_T": 1.06, "c": 0.8, "k": 0.97})
    machine = machine.replace(transmission=Transmission(PITCH, 0.85 * axis.transmission.k_d))
    estimate = estimate_gap(at_motor(swung(machine)), axis)
    assert estimate.method == motor_side.METHOD
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap - GAP) < 0.01 * GAP
    assert estimate.interval[0] < GAP < estimate.interval[1]


def test_a_motor_crosses_the_gap_when_its_torque_says() -> None:
    """From rest on one flank to the other in sqrt(2 gap J / torque); then the load slows it down."""
    torque, samples = 0.02, 200
    drive = TorqueDrive(INERTIA)
    axis = held_axis(motor=drive)
    still = MotorProblem(model_of(axis), np.zeros(samples), np.full(samples, torque), 1.0 / RATE, 0.0)
    predicted, driven = still.simulate(still.start(0.5 * PITCH * GAP, 1.0), 0.0)
    time, crossing = np.arange(samples) / RATE, math.sqrt(2.0 * GAP * INERTIA / torque)
    alone = 0.5 * torque / INERTIA * time**2 * PITCH
    np.testing.assert_allclose(predicted[time < crossing], alone[time < crossing], rtol=0.0, atol=1e-9 * PITCH)
    moved = driven > driven[0] + 1e-9 * PITCH
    assert time[moved][0] == pytest.approx(crossing, abs=1.0 / RATE)
    np.testing.assert_allclose((predicted - driven)[moved], 0.5 * PITCH * GAP, rtol=1e-9)
    assert predicted[-1] < 0.8 * alone[-1]


@pytest.mark.parametrize(("share", "rests"), [(0.5, True), (1.5, False), (-0.5, False)])
def test_a_motor_rests_on_its_flank_under_part_of_the_load(share: float, rests: bool) -> None:
    """A load on a spring, pulled off its place, pushes the screw back: the screw carries what the motor does not."""
    axis, half = held_axis(ground=0.3, motor=TorqueDrive(INERTIA)), 0.5 * PITCH * GAP
    pulled = 10.0 * half
    links = axis.chain()
    force = links.reaction_position * pulled + links.reaction @ links.equilibrium(pulled)
    command = np.full(50, share * PITCH * force)
    problem = MotorProblem(model_of(axis), np.full(50, pulled + half), command, 1.0 / RATE, 0.0)
    predicted, driven = problem.simulate(problem.start(half, -1.0), 0.0)
    if rests:
        np.testing.assert_allclose(predicted, pulled + half, rtol=1e-12)
        np.testing.assert_allclose(driven, pulled, rtol=1e-12)
    else:
        assert math.copysign(1.0, predicted[-1] - predicted[0]) == math.copysign(1.0, share)
        assert (driven[-1] > 1.001 * pulled) == (share > 0.0)


def test_the_motion_has_no_side_and_no_unit() -> None:
    """Everything with the other sign, or in thousandths, moves as before."""
    axis, run = AXES["on a spring"], swung(AXES["on a spring"])
    window = at_motor(run)
    assert window.theta_m is not None
    assert window.voltage is not None
    problem = MotorProblem(model_of(axis), PITCH * window.theta_m, window.voltage, 1.0 / RATE, 0.0)
    values = true_start(problem, run)
    linear = np.array([each.unit in ("load", "speed", "command") for each in problem.model.unknowns])
    plain, rate = problem.simulate(values, problem.model.speed)[0], problem.model.speed
    for factor in (-1.0, 1e-3):
        other = dataclasses.replace(problem, position=factor * problem.position, command=factor * problem.command)
        changed = np.where(linear, factor * values, values)
        changed[HALF] = abs(changed[HALF])
        np.testing.assert_allclose(other.simulate(changed, rate)[0], factor * plain, rtol=0.0, atol=1e-9 * abs(factor))


@pytest.mark.slow
def test_a_motor_that_stays_on_its_flank_shows_no_gap() -> None:
    """A load on a spring that is pushed forwards only."""
    axis = held_axis(ground=0.3)
    time = np.arange(800) / RATE
    rising = simulate(axis, 0.79, reference=Samples(time, 5e-3 * time), gap=GAP, sample_rate=RATE)
    seen = Window.from_run(rising, 0.2, 0.5)
    estimate = estimate_gap(Window(theta_m=seen.theta_m, voltage=seen.voltage, sample_rate=RATE), axis)
    assert not estimate.ok
    assert math.isnan(estimate.gap)


@pytest.mark.slow
def test_a_fit_that_leaves_more_than_noise_is_not_believed() -> None:
    """A wrong minimum was 40 % off and left 2 % of the gap, where the true one leaves a count."""
    window = at_motor(swung(AXES["one mass"]))
    assert window.theta_m is not None
    wobble = 0.05 * GAP * np.sin(20.0 * math.pi * np.arange(window.samples) / RATE)
    estimate = estimate_gap(window.replace(theta_m=window.theta_m + wobble), AXES["one mass"])
    assert not estimate.ok
    assert any("more than noise" in reason for reason in estimate.reasons)


@pytest.mark.slow
def test_the_twin_estimates_the_gap_and_verifies_no_setting() -> None:
    """The edge records the motor's angle as the position; what such a loop leaves of the load was never measured."""
    axis = AXES["one mass"]
    window = at_motor(swung(axis))
    recorded = window.replace(position=PITCH * np.asarray(window.theta_m))
    estimate = estimator_of(axis, TwinSettings(policy="paper", k_dz=0.0))(recorded, Expectation(0.8 * GAP))
    assert estimate.method == motor_side.METHOD
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] < GAP < estimate.interval[1]
    with pytest.raises(InvalidInput, match="verified for shafts that are free in the gap only"):
        check_gap_in_loop(axis)


@pytest.mark.slow
def test_a_quick_fit_tells_whether_the_gap_moved() -> None:
    axis = AXES["one mass"]
    fits, window = quick_fits_of(axis), at_motor(swung(axis))
    known = Known(GAP, fits.unknowns_at(window, Known(GAP)))
    found = fits.beside(at_motor(swung(axis, 1.06 * GAP)), known)
    assert found is not None
    assert found.gap == pytest.approx(1.06 * GAP, abs=0.02 * GAP)


def test_a_motor_that_stands_shows_nothing() -> None:
    window = Window(theta_m=np.full(500, 0.1), voltage=np.zeros(500), sample_rate=RATE)
    assert estimate_gap(window, AXES["one mass"]).status is GapStatus.UNIDENTIFIABLE


def test_a_load_that_is_light_beside_the_motor_is_refused() -> None:
    window = Window(theta_m=np.zeros(500), voltage=np.zeros(500), sample_rate=RATE)
    with pytest.raises(InvalidInput, match="inertia at the motor is 30 % of the motor's own"):
        estimate_gap(window, held_axis(heavy=0.3))


def test_a_rigid_screw_and_a_servo_are_refused() -> None:
    window = Window(theta_m=np.zeros(500), voltage=np.zeros(500), sample_rate=RATE)
    axis = held_axis(2)
    with pytest.raises(InvalidInput, match="the transmission is rigid"):
        estimate_gap(window, axis.replace(transmission=Transmission(PITCH)))
    with pytest.raises(InvalidInput, match="describe the machine as an axis"):
        estimate_gap(window, Servo.preset("paper").replace(k_d=1e6))
