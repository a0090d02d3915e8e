"""Time in which the offset of a command fades where nobody stated one: that of the loop, whatever the machine."""

import math

import numpy as np
import pytest
from scaling import AxisUnits, scaled_axis

from servotwin.control.controller import Controller
from servotwin.control.laws import law_of
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.load import Load
from servotwin.plant.plants import Plant, plant_of
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation.simulate import Simulation

SCREW = Axis.preset("ball-screw")


def unstated(plant: Plant) -> Plant:
    """The machine of the same file without the key."""
    lines = [line for line in plant.dumps().splitlines() if not line.startswith("release_time_s")]
    return plant_of("\n".join(lines), "unstated.toml")


@pytest.mark.parametrize("name", AXES)
def test_it_is_five_over_the_crossover(name: str) -> None:
    axis = Axis.preset(name)
    expected = 5.0 / axis.margins().gain_crossovers[0].omega
    assert axis.controller.release_time == law_of(axis.controller).release == expected
    assert unstated(axis) == axis
    assert Axis.loads(axis.dumps(), "axis.toml") == axis


def test_the_paper_s_is_half_a_second() -> None:
    paper = Servo.preset("paper")
    assert paper.controller.release_time == 0.5
    assert unstated(paper).controller.release_time == pytest.approx(0.5, rel=1e-4)


def test_a_stated_one_is_taken_as_it_is() -> None:
    axis = SCREW.replace(release_time=7.0)
    assert Axis.loads(axis.dumps(), "axis.toml").controller.release_time == 7.0
    assert axis.replace(Kp=2.0 * axis.pidf.Kp).controller.release_time == 7.0


@pytest.mark.parametrize("time", [1e-3, 0.1, 10.0, 1e3])
def test_a_slower_machine_has_a_longer_one(time: float) -> None:
    slower = scaled_axis(SCREW, AxisUnits(time, 1e3, 0.25, 8.0))
    assert slower.controller.release_time == pytest.approx(time * SCREW.pidf.release, rel=1e-9)


def test_a_loop_without_a_crossover_has_that_of_its_bandwidth() -> None:
    stepper = Axis.preset("stepper-stage")
    weak = stepper.replace(Kp=0.5 / stepper.p, Ki=0.0, Kd=0.0, release_time=None)
    found = weak.margins()
    assert not found.gain_crossovers
    assert weak.controller.release_time == 5.0 / found.bandwidth


def test_a_law_whose_machine_is_not_known_has_half_a_second() -> None:
    law = Controller(Kp=1.0, Ki=0.0, Kd=0.0, Tf=1.0, sample_rate=100.0)
    assert law.release_time is None
    assert law.law().release_step == pytest.approx(1.0 - math.exp(-1.0 / (100.0 * 0.5)), rel=1e-12)


def test_a_fast_machine_reaches_its_reference_in_its_own_time_after_a_change() -> None:
    """What the integral held within a step goes into the offset when the integral is left out, and fades."""
    mass, crossover, step = 0.02, 1000.0, 2e-5
    pitch = 1e-3 / (2.0 * math.pi)
    inertia = mass * pitch * pitch
    gain = inertia / pitch * crossover**2 / math.sqrt(1.0 + 9.0)
    own = Controller(Kp=gain, Ki=100.0 * gain, Kd=3.0 * gain / crossover, Tf=1e-4, sample_rate=20000.0)
    drive = TorqueDrive(J=inertia)
    axis = Axis(drive, Transmission(pitch), Load((mass,)), own)
    reference = SquareWave(step, 0.1)
    run = Simulation(axis, 0.4, reference=reference, sample_rate=20000.0)
    run.advance(4020)
    run.set_controller(axis.pidf.replace(Ki=0.0), None)
    run.advance(run.samples - 1)
    error = np.abs(run.run().reference - run.run().position)
    assert error[4500] > 1e-3 * step
    assert error[5990] < 1e-5 * step
    assert error[6990] < 1e-5 * step
