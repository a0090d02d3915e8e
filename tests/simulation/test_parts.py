"""Friction that falls, drives with a limit and loads that hang: every engine gives the same run."""

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.plant.actuator import DcMotor, Stepper, TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.simulation.ensemble import Cases, simulate_members
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled
from servotwin.simulation.simulate import Simulation

DRIVE = TorqueDrive(J=0.4, lag=1e-3, friction=0.05)
SHAFT = Transmission(p=1.0, k_d=3300.0, c_d=2.0, in_gap="free")
LAW = Controller(Kp=4.0, Ki=0.2, Kd=3.0, Tf=0.05)
HUNG = Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.4, force=-2.0)
FREE = Axis(DRIVE, SHAFT, HUNG, LAW)
SCREW = Transmission(3e-4)
ON_SHAFT = Transmission(3e-4, 1e5, 150.0, "free")
FALLING = TorqueDrive(J=0.4, lag=1e-3, friction=0.05, coulomb=0.2, static=0.5, stribeck=0.03, limit=2.5)
STICKY = FREE.replace(
    actuator=FALLING, load=Load((5.6,), (0.0,), (0.3,), "rotary", friction=0.6, static=0.9, stribeck=0.02)
)
GAP, REFERENCE = 0.03, SquareWave(0.2, 2.0)
HANGING = {
    "free": FREE,
    "free, motor's encoder": FREE.replace(sensors=Sensors(feedback="motor")),
    "on the ground": FREE.replace(load=Load((5.6,), (3.0,), (0.3,), "rotary", force=-2.0)),
    "on the ground inside the gap": FREE.replace(
        load=Load((5.6,), (900.0,), (9.0,), "rotary", force=-2.0), sensors=Sensors(feedback="motor")
    ),
    "held": FREE.replace(transmission=Transmission(1.0, 3300.0)),
    "rigid": Axis(
        DcMotor(5e-6, 12.0, 0.8, 0.1, 1e-3),
        SCREW,
        Load((5.2,) * 2, (1e4,) * 2, (36.9,) * 2, force=-3.0),
        Controller(300.0, 900.0, 0.0, 0.1),
    ),
    "stepper": Axis(
        Stepper(2e-2), SCREW, Load((5.2,) * 2, (0.0, 1e4), (0.0, 36.9), force=5.0), Controller(200.0, 1e4, 0.0, 0.1)
    ),
    "DC motor": Axis(
        DcMotor(5e-6, 12.0, 0.8, 0.1, 1e-3, 1e-4),
        ON_SHAFT,
        Load((5.2,) * 2, (0.0, 1e4), (9.0, 36.9), force=-3.0),
        Controller(300.0, 900.0, 0.0, 0.1),
    ),
    "velocity drive": Axis(
        VelocityDrive(5e-3),
        ON_SHAFT,
        Load((5.2,) * 2, (0.0, 1e4), (9.0, 36.9), force=-3.0),
        Controller(3e3, 1e4, 0.0, 0.1),
    ),
}


@pytest.mark.parametrize("name", HANGING)
@pytest.mark.parametrize("rate", [None, 1000.0, 10_000.0])
def test_a_load_that_hangs_does_not_drop(name: str, rate: float | None) -> None:
    """10 kHz runs in blocks of ticks, 1 kHz tick by tick."""
    axis = HANGING[name]
    run = simulate(axis, 2.1, controller=axis.controller.replace(sample_rate=rate), gap=GAP, sample_rate=1000.0)
    force, stiffness = abs(axis.load.force), 3300.0 if axis.load.motion == "rotary" else 1e4
    assert np.ptp(run.position) < 1e-12 * force / stiffness
    assert np.abs(run.voltage - run.voltage[0]).max() <= 1e-9 * max(abs(run.voltage[0]), 1e-3)
    sensed = axis.p * run.theta_m if axis.at_motor else run.position
    assert np.abs(sensed).max() < 1e-12 * force / stiffness
    assert not run.events.size


@pytest.mark.parametrize("rate", [None, 2000.0])
def test_a_cascade_holds_a_load_that_hangs(rate: float | None) -> None:
    law = Cascade(position_gain=3.0, ratio=1.0, velocity_gain=6.0, integral_time=0.5, sample_rate=rate)
    run = simulate(FREE, 1.0, controller=law, gap=GAP, sample_rate=1000.0)
    assert np.ptp(run.position) < 1e-12
    assert run.voltage[-1] == pytest.approx(2.0, rel=1e-9)


def test_a_law_without_integral_action_lets_the_load_sink_to_where_it_holds_it() -> None:
    law = Controller(Kp=40.0, Ki=0.0, Kd=30.0, Tf=0.01)
    run = simulate(FREE.replace(load=Load((5.6,), (0.0,), (0.3,), "rotary", force=-2.0)), 20.0, controller=law, gap=GAP)
    assert run.position[-1] == pytest.approx(-2.0 / 40.0, rel=1e-3)


AXES = {"friction that falls, limit": STICKY, "hanging": FREE}


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_members_of_an_ensemble_are_runs(name: str) -> None:
    axes = [AXES[name], AXES[name].scaled({"k": 1.2, "m": 0.9})]
    together = simulate_members(axes, LAW, 2.0, Cases(0.2, GAP), outputs=("position",))["position"]
    sampled = LAW.replace(sample_rate=1000.0)
    ticked = simulate_sampled(axes, sampled, 2.0, SampledCases(0.2, GAP), ("position",), sample_rate=100.0)["position"]
    for i, axis in enumerate(axes):
        for law, found in ((LAW, together), (sampled, ticked)):
            alone = simulate(axis, 2.0, controller=law, reference=0.2, gap=GAP, sample_rate=100.0).position
            assert np.abs(found[i] - alone).max() < 1e-9 * 0.2, (i, law)


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_blocks_of_ticks_are_the_ticks(name: str) -> None:
    law = LAW.replace(sample_rate=10_000.0)
    run = simulate(AXES[name], 2.5, controller=law, reference=REFERENCE, gap=GAP, sample_rate=1000.0)
    by_ticks = Simulation(AXES[name], 2.5, law, REFERENCE, GAP, sample_rate=1000.0)
    by_ticks.advance(by_ticks.samples - 1)
    assert np.abs(run.position - by_ticks.run().position).max() < 1e-9 * 0.2


def test_a_drive_follows_its_command_up_to_its_limit_and_the_bias_counts() -> None:
    axis = Axis(TorqueDrive(J=0.1, friction=0.05, limit=1.0), Transmission(1.0), Load((1.0,), motion="rotary"), LAW)
    run = simulate(axis, 1.0, reference=100.0, sample_rate=1000.0, input_bias=-0.5)
    assert run.voltage[0] > 100.0
    # Speed of an inertia with viscous friction under the limit.
    speed = 1.0 / 0.05 * (1.0 - np.exp(-0.5 * run.time))
    assert np.gradient(run.theta_m, run.time)[1:-1] == pytest.approx(speed[1:-1], abs=1e-5 * speed.max())
    assert "limit" in run.events.kind


def test_the_static_friction_holds_what_the_coulomb_friction_does_not() -> None:
    actuator = TorqueDrive(J=0.1, friction=0.5, coulomb=0.2, static=0.4, stribeck=0.1)
    law = Controller(Kp=0.3, Ki=0.0, Kd=0.0, Tf=0.1)

    def moved(drive: TorqueDrive) -> float:
        axis = Axis(drive, Transmission(1.0), Load((1.0,), motion="rotary"), law)
        return float(np.ptp(simulate(axis, 5.0, reference=1.0, sample_rate=100.0).theta_m))

    assert moved(actuator) == 0.0
    assert moved(TorqueDrive(J=0.1, friction=0.5, coulomb=0.2)) > 0.1
