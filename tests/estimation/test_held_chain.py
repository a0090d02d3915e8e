"""Gaps of loads with friction, and of elastic screws, that the gap holds: the play operator before a chain."""

import dataclasses
import math

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import default_method, estimate_gap
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.output_error.estimator import problem_of
from servotwin.estimation.output_error.held_chain import MovingChain, lever
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.window import Window
from servotwin.plant.actuator import DcMotor
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Run, simulate
from servotwin.twin.estimating import estimator_of, known_machine
from servotwin.twin.settings import TwinSettings

PAPER = Servo.preset("paper")
MOTOR = DcMotor(PAPER.J, PAPER.R, PAPER.k_T, PAPER.k_B, PAPER.L)
CALM = PAPER.controller.replace(Ki=0.0, Kp=0.7 * PAPER.controller.Kp, Kd=0.7 * PAPER.controller.Kd)
GAP = math.radians(10.0)


def screw_axis(masses: int, friction: float, stiffness: float = math.inf, grounded: bool = True) -> Axis:
    """The paper's chain of some masses behind a screw, with friction (N) at the last one."""
    springs = (1e4 if grounded else 0.0, *(masses - 1) * (1e4,))
    load = Load(masses * (5.2,), springs, masses * (36.9,), friction=friction)
    return Axis(MOTOR, Transmission(PAPER.p, stiffness), load, PAPER.controller)


AXES = {
    "two masses": screw_axis(2, 0.1),
    "three masses": screw_axis(3, 0.1),
    "elastic screw, one mass": screw_axis(1, 0.0, 5e4),
    "elastic screw, friction": screw_axis(2, 0.2, 1e5),
    "elastic screw, free load": screw_axis(2, 0.0, 1e5, grounded=False),
}


def worn(axis: Axis, law: Controller = PAPER.controller) -> Run:
    return simulate(axis, 8.0, controller=law, reference=SquareWave(1e-3, 8.0), gap=GAP)


def measured(run: Run, begin: float = 3.5, seconds: float = 3.0, noise: float = 0.0, seed: int = 3) -> Window:
    window = Window.from_run(run, begin, seconds)
    return window.replace(
        position=window.position + np.random.default_rng(seed).normal(0.0, noise, window.position.size)
    )


def error_from_rest(axis: Axis, rate: float) -> float:
    """Largest error of the model at its own numbers, over the motion of an exact run sampled at a rate (Hz)."""
    run = simulate(axis, 3.2, reference=SquareWave(1e-3, 8.0), gap=GAP, sample_rate=rate)
    problem, _ = problem_of(Window.from_run(run, 0.0, 3.0), axis, None)
    every = dataclasses.replace(problem, drive=lever(axis) * run.theta_m, position=run.position, interval=1.0 / rate)
    values = problem.model.start(0.5 * lever(axis) * GAP, 0.0, (0.0, 0.0))
    return float(np.abs(every.misfit(values)).max() / np.ptp(run.position))


@pytest.mark.parametrize("name", AXES)
def test_the_model_moves_as_the_exact_simulation_does(name: str) -> None:
    """The exact simulation locates contacts, sticks and slips as events."""
    coarse, fine = (error_from_rest(AXES[name], rate) for rate in (500.0, 2000.0))
    assert fine < 3e-5
    assert fine < 0.3 * coarse


def test_a_factor_on_the_force_moves_the_load_as_another_force_does() -> None:
    def moved(force: float, factor: float) -> np.ndarray:
        axis = screw_axis(2, 0.1)
        axis = axis.replace(load=dataclasses.replace(axis.load, force=force))
        problem, _ = problem_of(window, axis, None)
        values = problem.model.start(0.5 * lever(axis) * GAP, 0.0, (0.0, 0.0))
        at = [unknown.name for unknown in problem.model.unknowns].index("load force")
        values[at] = math.log(factor)
        return problem.motion(values).position

    window = measured(worn(screw_axis(2, 0.1)))
    assert np.ptp(moved(1.0, 2.0) - moved(1.0, 1.0)) > 0.01 * np.ptp(window.position)
    np.testing.assert_allclose(moved(1.0, 2.0), moved(2.0, 1.0), rtol=0.0, atol=1e-9 * np.ptp(window.position))


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_the_gap_is_right_and_inside_its_interval(name: str) -> None:
    axis = AXES[name]
    assert default_method(axis) == "output_error"
    estimate = estimate_gap(measured(worn(axis), noise=1e-6), axis)
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap - GAP) < math.radians(0.05)
    assert estimate.interval[0] < GAP < estimate.interval[1]


@pytest.mark.slow
def test_friction_of_another_size_is_fitted_and_widens_the_interval() -> None:
    axis, window = screw_axis(3, 0.1), measured(worn(screw_axis(3, 0.105)), noise=1e-6)
    right, off = estimate_gap(window, screw_axis(3, 0.105)), estimate_gap(window, axis)
    assert right.ok
    assert off.ok
    assert abs(off.gap - GAP) < math.radians(0.05)
    assert off.std_total > 2.0 * right.std_total


@pytest.mark.slow
def test_friction_that_is_twice_the_stated_one_is_no_gap() -> None:
    """The wind-up of the springs by the difference is as large as a third of the gap."""
    window = measured(worn(screw_axis(3, 0.2)), noise=1e-6)
    estimate = estimate_gap(window, screw_axis(3, 0.1))
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "with the stated load friction the gap would be" in estimate.reasons[0]
    off = float(estimate.reasons[0].rpartition(" best is ")[2].removesuffix(" % off"))
    assert off == pytest.approx(100.0, abs=5.0)


@pytest.mark.slow
def test_friction_within_what_is_known_of_it_is_believed() -> None:
    """The stated friction would make the gap 1.3 deg wider, and its interval just contains that."""
    window, axis = measured(worn(screw_axis(3, 0.118)), noise=1e-6), screw_axis(3, 0.1)
    estimate = estimate_gap(window, axis)
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap - GAP) < math.radians(0.05)
    wound = math.radians(1.295)
    assert wound < estimate.interval[1] - estimate.gap < 1.02 * wound
    refused = estimate_gap(window, axis, settings=OutputErrorSettings(friction=0.15))
    assert refused.status is GapStatus.UNIDENTIFIABLE
    assert refused.reasons[0].endswith("the friction that fits best is +18 % off")


def test_friction_that_falls_is_not_believed() -> None:
    load = dataclasses.replace(screw_axis(3, 0.1).load, static=0.12, stribeck=1e-3)
    falling = screw_axis(3, 0.1).replace(load=load)
    problem, _ = problem_of(measured(worn(screw_axis(3, 0.1))), falling, None)
    values = problem.model.start(0.5 * lever(falling) * GAP, 0.0, (0.0, 0.0))
    assert not problem.model.believes(values, 0.25)


def test_friction_that_could_be_all_of_the_gap_is_refused() -> None:
    """A fifth of the friction winds up more than the gap."""
    gap = math.radians(1.0)
    run = simulate(screw_axis(2, 0.24), 8.0, reference=SquareWave(1e-3, 8.0), gap=gap)
    estimate = estimate_gap(measured(run, noise=1e-7), screw_axis(2, 0.2))
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "with the stated load friction the gap would be" in estimate.reasons[0]


@pytest.mark.slow
def test_a_twin_believes_friction_as_far_as_it_is_known() -> None:
    window, axis = measured(worn(screw_axis(3, 0.118)), noise=1e-6), screw_axis(3, 0.1)
    known = TwinSettings().uncertainty
    for width, believed in ((0.25, True), (0.15, False)):
        settings = TwinSettings(uncertainty=known.replace(own_friction=width))
        assert estimator_of(axis, settings)(window, Expectation(None)).ok == believed


@pytest.mark.slow
def test_friction_that_falls_with_the_speed_widens_the_interval() -> None:
    axis = screw_axis(3, 0.02)
    falling = axis.replace(load=dataclasses.replace(axis.load, static=0.024, stribeck=1e-3))
    window = measured(worn(falling), noise=1e-6)
    plain, stated = estimate_gap(window, axis), estimate_gap(window, falling)
    assert stated.ok
    assert abs(stated.gap - GAP) < math.radians(0.05)
    assert stated.interval[0] < GAP < stated.interval[1]
    assert stated.std_total > plain.std_total


@pytest.mark.slow
def test_a_loop_that_touches_one_side_gets_a_lower_bound() -> None:
    run = worn(screw_axis(3, 0.1), CALM)
    estimate = estimate_gap(measured(run, 3.8, 2.0, noise=1e-6), screw_axis(3, 0.1))
    assert estimate.status in (GapStatus.LOWER_BOUND, GapStatus.UNIDENTIFIABLE)
    assert not estimate.gap > GAP


@pytest.mark.slow
def test_an_interval_with_gaps_that_the_motor_does_not_cross_has_no_upper_end() -> None:
    """The motor's way is 15 % wider than the gap; a load that swings on its own hides how little it is pushed."""
    axis, time = screw_axis(2, 0.01), np.arange(1000) / 200.0
    theta_m = 0.575 * GAP * np.cos(3.0 * math.pi * time / time[-1])
    still = Window(np.zeros(1000), theta_m, sample_rate=200.0)
    problem, _ = problem_of(still, axis, None)
    position = problem.motion(problem.model.start(0.5 * lever(axis) * GAP, 0.0, (0.0, 0.0))).position
    window = still.replace(position=position + np.random.default_rng(3).normal(0.0, 1e-8, position.size))
    assert estimate_gap(window, axis).ok
    unsure = estimate_gap(window, axis, settings=OutputErrorSettings(model_share=0.1))
    assert unsure.status is GapStatus.LOWER_BOUND
    assert 0.5 * GAP < unsure.gap < GAP


@pytest.mark.slow
def test_the_estimate_does_not_depend_on_units() -> None:
    """A thousandth of all lengths, with forces as they are."""
    axis, size = screw_axis(2, 0.1), 1e-3
    load = dataclasses.replace(axis.load, m=(5.2 / size,) * 2, k=(1e4 / size,) * 2, c=(36.9 / size,) * 2)
    small = axis.replace(load=load, transmission=Transmission(PAPER.p * size))
    window = measured(worn(axis), noise=1e-6)
    plain, scaled = estimate_gap(window, axis), estimate_gap(window.replace(position=size * window.position), small)
    assert plain.ok
    assert scaled.ok
    assert scaled.gap == pytest.approx(plain.gap, rel=1e-6)
    assert scaled.std_total == pytest.approx(plain.std_total, rel=1e-3)


def test_the_methods_of_a_servo_refuse_friction_in_a_sentence() -> None:
    window = Window(np.zeros(500), np.zeros(500), sample_rate=1e3)
    with pytest.raises(InvalidInput, match=r"load friction_n = 0.1 N: .* no Coulomb friction of the load"):
        estimate_gap(window, screw_axis(2, 0.1), "whitened")


def test_spikes_of_the_position_are_refused() -> None:
    window = measured(worn(screw_axis(2, 0.1)), noise=1e-6)
    spiked = window.position.copy()
    spiked[[2000, 7000]] += 2e-4
    assert estimate_gap(window.replace(position=spiked), screw_axis(2, 0.1)).status is GapStatus.MODEL_MISMATCH


@pytest.mark.parametrize("friction", [0.01, 0.05])
def test_a_servo_names_friction_that_nobody_stated(friction: float) -> None:
    window = measured(worn(screw_axis(3, friction)), noise=1e-6)
    estimate = estimate_gap(window, PAPER)
    assert not estimate.ok
    (words,) = [reason for reason in estimate.reasons if "Coulomb friction of the load" in reason]
    named = float(words.split("about ")[1].split(" N")[0])
    assert 0.5 * friction < named < 2.0 * friction


def test_other_faults_are_not_called_friction() -> None:
    run = simulate(PAPER.replace(c=tuple(1.3 * PAPER.dampings)), 8.0, reference=SquareWave(1e-3, 8.0), gap=GAP)
    estimate = estimate_gap(measured(run, noise=1e-6), PAPER)
    assert estimate.status is GapStatus.MODEL_MISMATCH
    assert not any("friction" in reason for reason in estimate.reasons)


def test_a_twin_keeps_the_numbers_of_such_a_machine() -> None:
    assert known_machine(screw_axis(2, 0.1), TwinSettings()) is None


def test_flexibility_and_static_gain_are_those_at_rest() -> None:
    chain = MovingChain.of(screw_axis(2, 0.0, 1e5))
    # 1e5 N/m to the screw and 1e4 N/m to the ground hold the first mass; 1e4 N/m the second at it.
    assert chain.static_gain() == pytest.approx(1e5 / 1.1e5)
    assert chain.flexibility() == pytest.approx(1.0 / 1.1e5 + 1e-4)
