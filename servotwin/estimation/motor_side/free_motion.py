"""Motion of a motor and a load whose shaft is free in the gap, under the motor's command."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from servotwin.estimation.motor_side.drive import MotorDrive
from servotwin.estimation.motor_side.motor import LoadStep, MotorStep, run_motor
from servotwin.estimation.output_error.models import ShaftModel
from servotwin.hybrid.exponential import expm1
from servotwin.plant.actuator import Actuator
from servotwin.plant.signals import Array

# Of a sample: the motor's speed is constant within each. A model with the true numbers left 7 to 15 counts of the
# encoder with one part, 0.4 to 2.4 with eight, and gaps were off by up to 5 %.
PARTS = 8


def free_motion(shaft: ShaftModel, drive: MotorDrive, values: Array, gains: Array) -> tuple[Array, Array]:
    """(N,) angle of the motor as predicted by an observer with `gains`, and driven end, both at the load, for the
    unknowns (u,) of the load."""
    axis, part = shaft.axis, drive.interval / PARTS
    step, by_command, by_torque = _steps(drive.actuator, axis.p, part)
    by = MotorStep(step, by_command, drive.reaction * by_torque, drive.friction / axis.p * by_torque[-2])
    # The load follows the simulated motor: of the measured one nothing is prepared.
    load = shaft.prepared(drive.measured[:1], part, values)
    predicted, driven = np.empty((2, drive.measured.size))
    run_motor(
        drive.measured,
        drive.command,
        PARTS,
        by,
        LoadStep(load.parts, load.interval, load.half, *load.matrices, load.friction, *_momentum(shaft, values)),
        gains,
        np.empty((len(load.scratch()) + 1, load.state.size)),
        drive.first,
        load.state,
        predicted,
        driven,
    )
    return predicted, driven


def _momentum(shaft: ShaftModel, values: Array) -> tuple[Array, tuple[float, float]]:
    """Rows of the load's momentum (2 n + 3,), stiffness to the ground, and constant force, for unknowns (u,)."""
    load, n = shaft.axis.load, shaft.axis.n
    known = zip(shaft.unknowns, values.tolist(), strict=True)
    factor = {unknown.name: math.exp(value) for unknown, value in known if unknown.unit in ("factor", "damping")}
    row = np.zeros(2 * n + 3)
    row[0] = factor.get("load damping", 1.0) * load.c[0]
    row[n : 2 * n] = load.m
    row[2 * n - 1] *= factor.get("mass ratio", 1.0)
    return row, (factor.get("load stiffness", 1.0) * load.k[0], factor.get("load force", 1.0) * load.force)


@lru_cache(maxsize=64)
def _steps(motor: Actuator, p: float, interval: float) -> tuple[Array, Array, Array]:
    """Step (d, d) of the actuator over an interval (s), speed and angle at the load (ratio p), and columns (d,) of a
    held command and of a force at the load."""
    shaft = motor.matrices()
    size = len(shaft.names)
    unit = np.ones(size)
    unit[-2:] = p
    flow = np.zeros((size + 2, size + 2))
    flow[:size, :size] = unit[:, None] * shaft.A / unit
    flow[:size, size], flow[:size, size + 1] = unit * shaft.B, p * unit * shaft.E
    step = np.eye(len(flow)) + expm1(flow, interval)
    return step[:size, :size].copy(), step[:size, size].copy(), step[:size, size + 1].copy()
