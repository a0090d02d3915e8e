"""Limit cycles and margins of every axis preset: exact map, describing function, long runs, and the tick."""

import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.signal import cont2discrete

import servotwin as st
from servotwin.analysis.limit_cycles.cycle import CycleStatus, limit_cycle
from servotwin.analysis.limit_cycles.describing import limit_cycle_near, predictions
from servotwin.analysis.limit_cycles.orbit import Orbit
from servotwin.control.running_law import RunningLaw, command_of
from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES
from servotwin.redesign.certified.margins import nominal_margins

# Healthy gaps at the load, m or rad, as the presets' files state them.
GAPS = {
    "two-mass-drive": 2e-3,
    "ball-screw": 5e-6,
    "robot-joint": math.radians(0.05),
    "telescope": math.radians(10.0 / 3600.0),
    "stepper-stage": 2e-6,
    "micro-positioner": 200e-9,
    "gantry": 5e-5,
    "emps": 1e-5,
}


class Miss(NamedTuple):
    """Largest relative errors of the describing function in frequency and amplitude, rounded upwards."""

    frequency: float
    amplitude: float


# Without friction and limit. The stiffer the shaft, the further the torque is from a sine; the motors of the
# micro-positioner and of the two-mass drive hardly swing beyond their gaps.
SWINGS = {
    "two-mass-drive": Miss(0.47, 0.13),
    "ball-screw": Miss(0.28, 0.05),
    "robot-joint": Miss(0.05, 0.04),
    "telescope": Miss(0.17, 0.11),
    "micro-positioner": Miss(0.28, 0.90),
    "gantry": Miss(0.22, 0.07),
}
# The stepper goes where it is told and its controller only integrates; the controller of the EMPS reads the motor.
CALM = ("stepper-stage", "emps")
# Friction holds the motor for minutes, until the integral has grown; then it slips.
HUNTING = ("robot-joint", "micro-positioner")


def gap_of(name: str) -> float:
    """Healthy gap, rad at the motor."""
    return GAPS[name] / st.Axis.preset(name).p


@cache
def bare(name: str) -> st.Axis:
    """A preset in continuous time without friction and limit."""
    axis = st.Axis.preset(name)
    actuator = axis.actuator
    if isinstance(actuator, st.TorqueDrive | st.DcMotor):
        actuator = replace(actuator, coulomb=0.0)
    return axis.replace(sample_rate=None, voltage_limit=None, actuator=actuator, load=replace(axis.load, friction=0.0))


@cache
def orbit_of(name: str) -> Orbit:
    (prediction,) = predictions(bare(name), gap_of(name))
    found = limit_cycle_near(bare(name), gap_of(name), prediction)
    assert found.status is CycleStatus.CYCLE
    assert found.orbit is not None
    return found.orbit


def test_every_preset_is_measured() -> None:
    assert set(AXES) == {*SWINGS, *CALM} == set(GAPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SWINGS)
def test_the_describing_function_is_near_the_exact_orbit(name: str) -> None:
    (prediction,) = predictions(bare(name), gap_of(name))
    orbit = orbit_of(name)
    assert prediction.stable
    assert orbit.stable
    assert prediction.frequency == pytest.approx(orbit.frequency, rel=SWINGS[name].frequency)
    assert prediction.amplitude == pytest.approx(orbit.amplitude, rel=SWINGS[name].amplitude)


@pytest.mark.parametrize("name", SWINGS)
def test_a_long_run_ends_on_the_exact_orbit(name: str) -> None:
    """After a step and a reversal: the micro-positioner rests after a step alone, as it comes from one side."""
    orbit, gap = orbit_of(name), GAPS[name]
    settling = 60.0 / st.Axis.preset(name).margins().gain_crossovers[0].omega
    duration = 2.0 * settling + 20.0 * orbit.period
    there = st.Samples([0.0, settling, 1.001 * settling, duration], [30.0 * gap, 30.0 * gap, 29.0 * gap, 29.0 * gap])
    run = st.simulate(bare(name), duration, reference=there, gap=gap_of(name), sample_rate=400.0 * orbit.frequency)
    last = run.position[-8000:]
    assert 0.5 * np.ptp(last) == pytest.approx(orbit.amplitude, rel=1e-4)
    contacts = run.events.time[run.events.kind == "contact"][-21:]
    assert 10.0 / (contacts[-1] - contacts[0]) == pytest.approx(orbit.frequency, rel=1e-4)


@pytest.mark.parametrize("name", CALM)
def test_no_cycle_is_predicted_and_none_is_found(name: str) -> None:
    assert limit_cycle(bare(name), gap_of(name), step=30.0 * GAPS[name]).status is CycleStatus.SETTLES
    if name == "emps":
        with pytest.raises(InvalidInput, match="outside of a loop on the motor's encoder"):
            predictions(bare(name), gap_of(name))
    else:
        assert predictions(bare(name), gap_of(name)) == ()


@pytest.mark.parametrize("name", GAPS)
def test_the_preset_ends_as_the_exact_map_says(name: str) -> None:
    """With its friction and its limit, in continuous time."""
    axis, step = st.Axis.preset(name).replace(sample_rate=None), 30.0 * GAPS[name]
    found = limit_cycle(axis, gap_of(name), step=step)
    duration = 250.0 / axis.margins().gain_crossovers[0].omega
    duration *= 40.0 if name in HUNTING else 1.0
    run = st.simulate(axis, duration, reference=step, gap=gap_of(name), sample_rate=20_000.0 / duration)
    swing = 0.5 * np.ptp(run.position[-(8000 if name in HUNTING else 2000) :])
    if name == "robot-joint":
        assert found.status is CycleStatus.IRREGULAR
        assert swing > 0.5 * GAPS[name]
    elif name in ("two-mass-drive", "micro-positioner"):
        assert found.orbit is not None
        assert swing == pytest.approx(found.orbit.amplitude, rel=1e-2)
    else:
        assert found.status is CycleStatus.SETTLES
        assert swing < 1e-8 * GAPS[name]


def sensitivity_peak(axis: st.Axis) -> float:
    """Largest response of command to a disturbance of the command, of the edge's own tick on scipy's sampled plant."""
    law, motor, load = RunningLaw(axis.controller.replace(voltage_limit=None), None), *axis.plants()
    step = 1.0 / (axis.controller.sample_rate or math.nan)
    A, B, C, *_ = cont2discrete((load.A, load.B[:, None], np.stack([motor.C, load.C]), np.zeros((2, 1))), step)
    state, x = law.start(0.0, 0.0), np.zeros(len(A))
    total = np.empty(round(80.0 / axis.margins().gain_crossovers[0].omega / step))
    for k in range(total.size):
        theta_m, position = C @ x
        measured = axis.p * theta_m if axis.at_motor else position
        state = law.tick(state, 0.0, theta_m, measured)
        total[k] = command_of(state) + (k == 0)
        x = A @ x + B[:, 0] * total[k]
    return float(np.abs(np.fft.rfft(total, 2**17)).max())


@pytest.mark.parametrize("name", GAPS)
def test_sampled_margins_are_those_of_the_tick(name: str) -> None:
    axis = st.Axis.preset(name)
    margins = nominal_margins(axis, axis.controller)
    assert margins.stable
    assert margins.Ms == pytest.approx(sensitivity_peak(axis), rel=2e-3)
