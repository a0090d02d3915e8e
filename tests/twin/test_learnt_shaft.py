"""Stiffness and damping of a shaft that is free in the gap, learnt by a twin across windows."""

import math
from functools import cache

import msgspec
import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.estimation import output_error
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.machine import LearningSettings, LearntMachine
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.twin.estimating import estimator_of, known_machine, stated_machine
from servotwin.twin.settings import TwinSettings

MODEL = Axis(
    TorqueDrive(J=0.4, lag=1e-3, friction=0.05),
    Transmission(p=1.0, k_d=3300.0, c_d=20.0, in_gap="free"),
    Load((5.6,), (0.0,), (0.3,), "rotary"),
    Controller(Kp=60.0, Ki=20.0, Kd=40.0, Tf=0.01),
)
GEARED = Axis(
    TorqueDrive(J=0.0123, friction=3.6e-4),
    Transmission(0.02, 8.2, 3.3, "free"),
    Load((90.6,), (0.0,), (2.84,), "rotary"),
    Controller(Kp=4.21e-3, Ki=0.0, Kd=0.1715, Tf=1.7),
)
ROBOT = Axis(
    TorqueDrive(J=40.2, friction=23.3),
    Transmission(0.02, 2.905e6, 4.56e4, "free"),
    Load((8.637e4,), (0.0,), (5.676e4,), "rotary"),
    Controller(Kp=2504.6, Ki=0.0, Kd=5190.5, Tf=0.08635, sample_rate=145.0),
    Sensors(2.0 * math.pi / 65536, 2.0 * math.pi / 2**24),
)
GAP, NOISE = 0.03, 2e-5
SETTINGS = TwinSettings(policy="paper", k_dz=0.0)
K, C = 0, 1


@cache
def seen(k: float, c: float, number: int) -> Window:
    """Three seconds of a machine whose shaft is off its model by these factors, each with noise of its own."""
    machine = MODEL.replace(transmission=Transmission(1.0, 3300.0 * k, 20.0 * c, "free"))
    run = simulate(machine, 4.0, reference=SquareWave(0.2, 4.0), gap=GAP, sample_rate=1000.0)
    part, noise = slice(200, 3200), NOISE * np.random.default_rng(number).normal(size=3000)
    return Window(run.position[part] + noise, run.theta_m[part], sample_rate=1000.0, start=100.0 * number)


def followed(windows: list[Window], wear: Wear) -> list[tuple[GapEstimate, Wear]]:
    """Estimates of windows, each with what the ones before it told, and the knowledge after them."""
    estimator, stated, results = estimator_of(MODEL, SETTINGS), stated_machine(SETTINGS), []
    for window in windows:
        now = window.mid_time
        estimate = estimator(window, wear.expect(SETTINGS.trend, "boot", now, now, SETTINGS.learning))
        wear, _ = wear.update(SETTINGS.trend, "boot", estimate, now, SETTINGS.learning, stated)
        results.append((estimate, wear))
    return results


@cache
def learnt() -> list[tuple[GapEstimate, Wear]]:
    """Three windows of a machine that is 4 % stiffer and a quarter less damped than its model."""
    return followed([seen(1.04, 0.75, number) for number in range(3)], Wear(0.0))


def known_to(damping: float) -> FactorPrior:
    """A stiffness that is known to 1 %, and the damping to a share."""
    return FactorPrior(np.zeros(4), np.diag(np.square([0.01, damping, 0.005, 0.05])))


def machine_of(wear: Wear) -> LearntMachine:
    assert wear.machine is not None
    return wear.machine


def spreads(machine: LearntMachine) -> np.ndarray:
    return np.sqrt(np.diag(np.array(machine.covariance).reshape(4, 4)))


@pytest.mark.slow
def test_a_free_shaft_s_stiffness_and_damping_are_learnt_and_its_ratio_is_not() -> None:
    new = known_machine(MODEL, SETTINGS)
    assert new is not None
    for estimate, wear in learnt():
        assert estimate.ok, estimate.reasons
        assert estimate.interval[0] < GAP < estimate.interval[1]
        machine = machine_of(wear)
        errors = np.abs(np.array(machine.factors[:2]) - np.log([1.04, 0.75])) / spreads(machine)[:2]
        assert errors.max() < 2.5
        assert machine.factors[2:] == (0.0, 0.0)
        assert spreads(machine)[2] == pytest.approx(new.pitch[1], rel=1e-12)
    last = spreads(machine_of(learnt()[-1][1]))
    assert last[K] < 0.2 * math.sqrt(new.covariance[K, K])
    assert last[C] < 0.5 * math.sqrt(new.covariance[C, C])


@pytest.mark.slow
def test_a_damping_that_nothing_was_known_of_is_no_contradiction() -> None:
    """Before the first window a damping may be off by any factor."""
    ((estimate, wear),) = followed([seen(1.0, 0.04, 0)], Wear(0.0))
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] < GAP < estimate.interval[1]
    assert machine_of(wear).factors[C] < math.log(0.5)


@pytest.mark.slow
def test_what_was_learnt_is_the_prior_of_the_next_window_and_repeats_bit_for_bit() -> None:
    (_, before), (estimate, _) = learnt()[0], learnt()[1]
    stored = msgspec.msgpack.decode(msgspec.msgpack.encode(before), type=Wear)
    ((again, _),) = followed([seen(1.04, 0.75, 1)], stored)
    assert again == estimate
    ((afresh, _),) = followed([seen(1.04, 0.75, 1)], Wear(0.0))
    assert afresh.gap != estimate.gap
    assert estimate.std <= 1.05 * afresh.std


@pytest.mark.slow
def test_the_same_window_again_tells_no_more_of_the_machine() -> None:
    """Its errors repeat: a window counts only where it tells a number twice as well as it was known."""
    first, second = (machine_of(wear) for _, wear in followed([seen(1.04, 0.75, 0)] * 2, Wear(0.0)))
    assert np.all(spreads(second)[:2] > 0.45 * spreads(first)[:2])
    assert second.windows == 1 or second.factors == pytest.approx(first.factors, abs=float(spreads(first).max()))


@pytest.mark.slow
def test_another_machine_under_the_same_name_is_refused_and_learnt_when_three_windows_agree() -> None:
    others = followed([seen(0.85, 1.2, number) for number in (10, 11, 12, 13)], learnt()[-1][1])
    assert [estimate.status for estimate, _ in others] == [GapStatus.MODEL_MISMATCH] * 3 + [GapStatus.OK]
    machines = [machine_of(wear) for _, wear in others]
    assert [machine.disputed for machine in machines] == [True, True, False, False]
    assert all("not the one that was learnt" in machine.alarm for machine in machines[:3])
    assert "learnt anew" in machines[2].alarm
    assert abs(machines[-1].factors[K] - math.log(0.85)) < 2.5 * spreads(machines[-1])[K]
    last = others[-1][0]
    assert last.interval[0] < GAP < last.interval[1]


@pytest.mark.slow
@pytest.mark.parametrize(("inertia", "step"), [(1.6, 0.0148), (2.0, 0.011)])
def test_a_payload_that_has_changed_gives_no_bound_above_the_gap(inertia: float, step: float) -> None:
    """Within what was learnt one flank explains the window best, and bounds were more than twice the gap."""
    gap, machine = 0.0965, known_to(0.05)
    loaded = GEARED.scaled({"m": inertia})
    run = simulate(loaded, 1100.0, reference=SquareWave(step, 850.0), gap=gap, sample_rate=7.36)
    settings, window = output_error.OutputErrorSettings(), Window.from_run(run, 850.0, 204.0)
    made = output_error.estimate(window, GEARED, None, settings, machine)
    assert not made.ok
    assert made.interval[0] <= gap


@pytest.mark.slow
def test_a_gap_that_grows_within_the_window_is_no_softer_shaft() -> None:
    """It grows by 1.9 %, which moves the fit's gap by 10 % and its stiffness by more than is known of it."""
    machine, settings = known_to(0.1), output_error.OutputErrorSettings(gap_rate=3.26e-4)
    gap = SCurve(0.145, 0.22, 345.4, begin=-124.3)
    run = simulate(ROBOT, 54.0, reference=SquareWave(0.0177174, 43.17), gap=gap, sample_rate=145.0)
    made = output_error.estimate(Window.from_run(run, 43.172, 10.4), ROBOT, None, settings, machine)
    assert made.ok, made.reasons
    assert made.interval[0] <= float(np.interp(made.time, run.time, run.gap)) <= made.interval[1]


def test_a_free_shaft_learns_nothing_where_learning_is_off() -> None:
    unlearning = TwinSettings(policy="paper", k_dz=0.0, learning=LearningSettings(learn=False))
    assert known_machine(MODEL, unlearning) is None
