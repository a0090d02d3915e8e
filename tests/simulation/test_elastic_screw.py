"""An elastic screw whose load acts back on the motor: the motor may rest at a flank under part of the load."""

import itertools
import math

import numpy as np
import pytest
from exploration import examples
from held_screw import HeldScrew
from hypothesis import given
from hypothesis import strategies as st

from servotwin.control.controller import Controller
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Run, Simulation, simulate

PAPER = Servo.preset("paper")


def run_of(servo: Servo, gap: float, **options) -> tuple[Run, dict[str, np.ndarray]]:
    simulation = Simulation(servo, 10.0, reference=SquareWave(1e-3, 5.0), gap=gap, **options)
    simulation.advance(simulation.samples - 1)
    engine = simulation.engine
    rows = np.eye(len(engine.loop.automaton.names))
    states = {name: engine.trajectory.sampled(rows[engine.loop.automaton.index(name)]) for name in ("current", "speed")}
    return simulation.run(), states


@pytest.mark.parametrize("damping", [0.0, 60.0, 400.0])
def test_a_screw_with_a_damper_moves_as_small_steps_say(damping: float) -> None:
    """A worm: the damper acts on the load beside the spring, and on the motor in contact only."""
    own = HeldScrew(1e-3, 1e-3, 2e-3, 0.01, 5e4, 3.0, 20.0, (8.0, 4.0, 0.4, 5e-3), 1e-9, 1e3, 0.1, damping)
    axis = Axis(
        TorqueDrive(J=own.J, lag=own.lag, friction=own.friction),
        Transmission(own.p, own.k, damping),
        Load((own.m,), c=(own.c,)),
        Controller(*own.gains, sample_rate=own.rate),
        Sensors(own.count, feedback="motor"),
    )
    run = simulate(axis, 3.0, reference=SquareWave(0.02, 2.0), gap=own.gap, sample_rate=own.rate)
    assert {"contact", "hold", "release"} <= set(run.events.kind.tolist())
    # Both differences are those of the steps, which are of first order.
    coarse, fine = (np.abs(own.run(run.reference, parts)[2] - run.position).max() for parts in (30, 300))
    assert fine < 2e-4 * np.abs(run.position).max()
    assert fine < 0.2 * coarse


def held_samples(run: Run, side: int) -> np.ndarray:
    """Samples strictly inside the stretches between hold and what ends it."""
    backlash = run.events[np.isin(run.events.kind, ("hold", "release", "contact"))]
    inside = np.zeros(run.samples, dtype=bool)
    for now, after in itertools.pairwise(backlash):
        if now.kind == "hold" and now.side == side and after.time > now.time:
            inside |= (run.time > now.time) & (run.time < after.time)
    return inside


def test_at_rest_on_a_flank_the_motor_carries_part_of_the_load() -> None:
    servo = PAPER.replace(k_d=2e5)
    run, states = run_of(servo, math.radians(5.0), tolerance=servo.tolerance_for(math.radians(5.0)))
    load = servo.p * servo.k_d * (servo.p * run.theta_d - run.q[:, 0])
    torque = servo.k_T * states["current"]
    found = 0
    for side in (1, -1):
        inside = held_samples(run, side)
        found += int(inside.sum())
        assert np.all(np.abs(states["speed"][inside]) <= 1e-12)
        assert np.all(side * torque[inside] >= -1e-12)
        assert np.all(side * (load - torque)[inside] >= -1e-12)
        assert np.allclose(run.theta_m[inside] - run.theta_d[inside], side * 0.5 * run.gap[inside], atol=1e-12)
    assert found > 100


@examples(25)
@given(
    st.floats(4.5, 7.0),
    st.sampled_from([2, 3, 5]),
    st.floats(0.0, 20.0),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0.0, 1e-4, 0.003, 0.05]),
)
def test_no_elastic_screw_chatters(
    stiffness: float, masses: int, degrees: float, wearing: bool, zone: bool, volts: float
) -> None:
    servo = PAPER.replace(k_d=10.0**stiffness, n=masses)
    gap = math.radians(degrees)
    run, _ = run_of(
        servo,
        SCurve(0.0, gap, duration=10.0) if wearing else gap,
        tolerance=servo.tolerance_for(gap) if zone else None,
        friction=volts * servo.torque_of(1.0),
    )
    slack = 1e-12 * (1.0 + np.max(np.abs(run.theta_m)))
    assert np.all(np.abs(run.theta_m - run.theta_d) <= 0.5 * run.gap + slack)


@pytest.mark.parametrize("rate", [None, 1000.0])
@pytest.mark.parametrize("widths", [(5.0, 5.0), (0.0, 8.0), (8.0, 1.0)])
def test_friction_that_vanishes_changes_nothing(widths: tuple[float, float], rate: float | None) -> None:
    """Stuck on a flank under part of the load, or held there by the screw alone: the difference goes with friction."""
    servo = PAPER.replace(k_d=1e6)
    first, last = np.radians(widths)
    options = {
        "controller": servo.controller.replace(Ki=200.0, sample_rate=rate),
        "reference": SquareWave(1e-3, 4.0),
        "gap": SCurve(first, last, duration=5.0) if first != last else first,
        "sample_rate": 1000.0,
    }
    without = simulate(servo, 6.0, **options)
    moved = []
    for volts in (1e-7, 1e-5):
        run = simulate(servo, 6.0, friction=volts * servo.torque_of(1.0), **options)
        assert {"stick", "slip"} < set(run.events.kind.tolist())
        moved.append(np.abs(run.position - without.position)[:3000].max())
    assert moved[0] < 1e-6 * np.abs(without.position).max()
    assert moved[1] == pytest.approx(100.0 * moved[0], rel=1e-2)


def test_a_motor_stuck_on_its_flank_carries_what_its_friction_can() -> None:
    """It goes on where its torque exceeds load and friction together, and off the flank where friction alone."""
    servo = PAPER.replace(k_d=2e5)
    friction = 0.02 * servo.torque_of(1.0)
    run, states = run_of(servo, math.radians(5.0), friction=friction)
    load = servo.p * servo.k_d * (servo.p * run.theta_d - run.q[:, 0])
    torque = servo.k_T * states["current"]
    slack, found = 1e-9 * friction, 0
    for side in (1, -1):
        inside = held_samples(run, side) & (states["speed"] == 0.0)
        found += int(inside.sum())
        assert np.all(side * torque[inside] >= -friction - slack)
        assert np.all(side * (torque - load)[inside] <= friction + slack)
        assert np.allclose(run.theta_m[inside] - run.theta_d[inside], side * 0.5 * run.gap[inside], atol=1e-12)
    assert found > 100
    assert np.any(np.abs(torque - load)[states["speed"] == 0.0] > 3.0 * friction)
