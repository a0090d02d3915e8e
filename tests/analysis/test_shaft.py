"""Describing function of a dead zone in a shaft, against its definition, the exact map and a long run."""

import dataclasses
import math

import numpy as np
import pytest

from servotwin.analysis.limit_cycles.cycle import CycleStatus
from servotwin.analysis.limit_cycles.describing import limit_cycle_near, predictions
from servotwin.analysis.limit_cycles.shaft import OpenShaft, dead_zone_function
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

GAP = 0.02


def soft(position_rate: float, load: float = 1.2, damping: float = 2.0) -> Axis:
    """Two inertias on a soft shaft, under a law with a crossover (rad/s) below the shaft's frequency."""
    total = 0.4 + load
    law = Controller(
        Kp=total * position_rate**2, Ki=0.1 * total * position_rate**3, Kd=1.5 * total * position_rate,
        Tf=0.1 / position_rate,
    )  # fmt: skip
    return Axis(
        TorqueDrive(0.4, friction=0.2),
        Transmission(1.0, 300.0, damping, "free"),
        Load((load,), (0.0,), (0.1,), "rotary"),
        law,
    )


@pytest.mark.parametrize("amplitude", [0.005, 0.0101, 0.02, 0.3])
def test_the_function_is_the_first_harmonic(amplitude: float) -> None:
    phase = (np.arange(200_000) + 0.5) * 2e-5 * math.pi / 2.0
    angle = amplitude * np.sin(phase)
    beyond = np.sign(angle) * np.maximum(np.abs(angle) - 0.5 * GAP, 0.0)
    assert dead_zone_function(amplitude, GAP) == pytest.approx(
        2.0 * np.mean(beyond * np.sin(phase)) / amplitude, abs=1e-8
    )


def test_the_parted_shaft_closes_to_the_loop_without_a_gap() -> None:
    """Where N = 1 gives a root on the axis, so do the poles of the whole loop."""
    axis = soft(3.0)
    parted = OpenShaft.of(axis, axis.pidf)
    torque = parted.stiffness * parted.twist + parted.damping * (parted.twist @ parted.A)
    closed = np.linalg.eigvals(parted.A + np.outer(parted.B, torque))
    for pole in axis.closed_loop().poles():
        assert np.abs(closed - pole).min() < 1e-6 * abs(pole)


@pytest.mark.parametrize("axis", [soft(3.0), soft(4.0)])
def test_it_predicts_the_cycle_of_a_soft_shaft(axis: Axis) -> None:
    (prediction,) = [one for one in predictions(axis, GAP) if one.stable]
    assert prediction.motor_amplitude > 1.5 * 0.5 * GAP
    near = limit_cycle_near(axis, GAP, prediction)
    assert near.status is CycleStatus.CYCLE
    assert near.orbit is not None
    assert prediction.frequency == pytest.approx(near.orbit.frequency, rel=0.07)
    assert prediction.amplitude == pytest.approx(near.orbit.amplitude, rel=0.15)
    run = simulate(axis, 120.0, reference=2.0 * prediction.amplitude, gap=GAP, sample_rate=200.0)
    assert 0.5 * np.ptp(run.position[-4000:]) == pytest.approx(near.orbit.amplitude, rel=1e-3)


def test_a_filtered_pid_written_as_a_linear_law_has_the_same_cycles() -> None:
    axis = soft(4.0)
    pid = axis.pidf
    law = LinearLaw(
        A=((0.0, 0.0), (0.0, -1.0 / pid.Tf)), B=((pid.Ki, 0.0, -pid.Ki), (0.0, 0.0, -1.0 / pid.Tf)),
        C=(1.0, -pid.Kd / pid.Tf), D=(pid.Kp, 0.0, -pid.Kp - pid.Kd / pid.Tf),
    )  # fmt: skip
    (one,), (other,) = predictions(axis, GAP), predictions(axis, GAP, law)
    assert dataclasses.astuple(other) == pytest.approx(dataclasses.astuple(one), rel=1e-9)


@pytest.mark.parametrize(("gains", "miss"), [((4.0, 8.0, 0.2), 0.2), ((8.0, 6.0, 0.3), 0.03)])
def test_it_predicts_the_cycle_of_a_cascade(gains: tuple[float, float, float], miss: float) -> None:
    """Its velocity loop is closed on the motor, before the gap; the wider the swing, the nearer the prediction."""
    axis = soft(4.0)
    cascade = Cascade(gains[0], 1.0, velocity_gain=gains[1], integral_time=gains[2])
    (prediction,) = predictions(axis, GAP, cascade)
    near = limit_cycle_near(axis, GAP, prediction, cascade)
    assert prediction.stable
    assert near.orbit is not None
    assert prediction.frequency == pytest.approx(near.orbit.frequency, rel=miss)
    assert prediction.amplitude == pytest.approx(near.orbit.amplitude, rel=miss)
    run = simulate(axis, 60.0, controller=cascade, reference=0.1, gap=GAP, sample_rate=200.0)
    assert 0.5 * np.ptp(run.position[-2000:]) == pytest.approx(near.orbit.amplitude, rel=1e-3)


def test_a_law_that_reads_an_encoder_which_is_not_there_is_refused() -> None:
    axis = soft(4.0).replace(sensors=Sensors(feedback="motor"))
    with pytest.raises(InvalidInput, match="the controller reads y_load"):
        predictions(axis, GAP, Cascade(4.0, 1.0, velocity_gain=8.0))


def test_it_is_proportional_to_the_gap() -> None:
    single, double = (predictions(soft(4.0), gap)[0] for gap in (GAP, 2.0 * GAP))
    assert double.amplitude == pytest.approx(2.0 * single.amplitude, rel=1e-9)
    assert double.frequency == pytest.approx(single.frequency, rel=1e-12)


def test_forces_are_refused() -> None:
    axis = soft(4.0)
    with pytest.raises(InvalidInput, match="the axis has friction or a force too"):
        predictions(axis.replace(load=Load((1.2,), (0.0,), (0.1,), "rotary", force=1.0)), GAP)
