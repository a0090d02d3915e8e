"""Gaps behind an elastic screw that the gap holds, of loops on the motor's encoder, by a simulation of its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
from held_screw import HeldScrew

from servotwin.control.controller import Controller
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import Samples
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

RATE, PITCH, COUNT, PARTS = 1000.0, 1e-3, 1e-4, 200
INERTIA, HEAVY = 1e-4, 2.0
MASS = HEAVY * INERTIA / PITCH**2
STIFFNESS = MASS * (2.0 * math.pi * 30.0) ** 2
GAIN = INERTIA * (1.0 + HEAVY) * (4.0 * math.pi) ** 2 / PITCH
PIDF = (GAIN, GAIN * 4.0 * math.pi / 6.0, 1.35 * GAIN / (4.0 * math.pi), 0.1 / (4.0 * math.pi))
AXIS = Axis(
    TorqueDrive(INERTIA, 4e-4, 1e-4),
    Transmission(PITCH, STIFFNESS),
    Load((MASS,), (0.0,), (3.0 * MASS,)),
    Controller(*PIDF, sample_rate=RATE),
    Sensors(COUNT, feedback="motor"),
)
TIME = np.arange(1800) / RATE
SINE = 2e-3 * np.sin(2.0 * math.pi * TIME)


def machine(gap: float, off: np.random.Generator | None = None) -> HeldScrew:
    """The axis itself, or one whose numbers are off by as much as the estimate allows for."""
    own = HeldScrew(INERTIA, 4e-4, 1e-4, PITCH, STIFFNESS, MASS, 3.0 * MASS, PIDF, COUNT, RATE, gap)
    if off is None:
        return own
    k, m, c, friction = 1.0 + off.uniform(-1.0, 1.0, 4) * (0.15, 0.04, 0.25, 0.25)
    return replace(own, k=own.k * k, m=own.m * m, c=own.c * c, friction=own.friction * friction)


def test_small_steps_and_located_events_move_alike() -> None:
    """To the first order of the small steps."""
    gap = 0.3
    exact = simulate(AXIS, TIME[-1], reference=Samples(TIME.tolist(), SINE.tolist()), gap=gap, sample_rate=RATE)
    apart = []
    for parts in (50, 200):
        angle, _, place = machine(gap).run(SINE, parts)
        apart.append((np.abs(angle - exact.theta_m).max() / gap, np.abs(place - exact.position).max() / (PITCH * gap)))
    assert max(apart[1]) < 0.02
    assert apart[1][1] < 0.5 * apart[0][1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("encoders", [1, 2])
@pytest.mark.parametrize("damped", [0.0, 0.1])
def test_the_gap_of_a_loop_on_the_motor_is_found_from_one_encoder_and_from_two(
    seed: int, encoders: int, damped: float
) -> None:
    """Of machines whose numbers are not those of the model; the load's encoder is beside the loop.

    `damped` is the damping ratio of the load on its screw, of which the machine has a quarter less.
    """
    random = np.random.default_rng([30113060, seed])
    gap = math.exp(random.uniform(math.log(0.1), math.log(0.5)))
    damping = 2.0 * damped * math.sqrt(STIFFNESS * MASS)
    angle, command, place = replace(machine(gap, random), damping=0.75 * damping).run(SINE, PARTS)
    seen, axis = slice(900, 1700), AXIS.replace(transmission=Transmission(PITCH, STIFFNESS, damping))
    window = Window(theta_m=angle[seen], voltage=command[seen], sample_rate=RATE)
    if encoders == 2:
        resolution = 5e-8
        axis = axis.replace(sensors=Sensors(COUNT, resolution))
        load = resolution * np.round(place[seen] / resolution)
        window = Window(position=load, theta_m=angle[seen], voltage=command[seen], sample_rate=RATE)
    estimate = estimate_gap(window, axis)
    assert estimate.method == ("motor_side" if encoders == 1 else "output_error")
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap / gap - 1.0) < 0.005
    assert estimate.interval[0] < gap < estimate.interval[1]
