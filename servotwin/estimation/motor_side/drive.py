"""Motor of a window in a simulation with its load: its numbers, its command, and the observer's gains."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.hybrid.exponential import expm1
from servotwin.plant.actuator import Actuator
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

_DOUBLINGS = 24  # of the Riccati equation: 2^24 samples


class MotorDrive(NamedTuple):
    """Motor with its command; speed and angle at the load.

    Attributes
    ----------
    actuator : Actuator
    reaction : float
        Factor on what the load's force does to the motor.
    friction : float
        N m, Coulomb friction.
    command : (N,) array
        In the actuator's unit, held from each sample to the next.
    first : (d,) array
        States at the first sample.
    measured : (N,) array
        Motor's angle at the load, m or rad.
    interval : float
        s.
    """

    actuator: Actuator
    reaction: float
    friction: float
    command: Array
    first: Array
    measured: Array
    interval: float


def states_at(actuator: Actuator, command: float, speed: float, place: float) -> Array:
    """States (d,) of a motor with a speed and a place at the load, whose current has settled under a command."""
    shaft = actuator.matrices()
    states = np.zeros(len(shaft.names))
    if states.size > 2:
        states[:-2] = -np.linalg.solve(shaft.A[:-2, :-2], shaft.B[:-2]) * command
    states[-2:] = speed, place
    return states


@lru_cache(maxsize=64)
def observer_gains(axis: Axis, interval: float, rate: float) -> Array:
    """(2, 2 n + 2) gains of the observer in the gap and in contact: Kalman's, with disturbances of all accelerations.

    In the gap the motor alone has the rate (1/s).
    """
    load, n = axis.load, axis.n
    links = chain(load.masses, load.stiffnesses, load.dampings, axis.transmission.k_d, axis.transmission.c_d)
    inertia = 1.0 / (axis.p**2 * float(axis.shaft().E[-2]))
    gains = np.zeros((2, 2 * n + 2))
    gains[0, :2] = 2.0 * rate * interval, rate * rate * interval
    # Motor's angle and speed, positions and speeds of the load, all at the load.
    flow = np.zeros((2 * n + 2, 2 * n + 2))
    flow[0, 1] = 1.0
    flow[1, :2] = -axis.transmission.k_d / inertia, -axis.transmission.c_d / inertia
    flow[1, 2:] = -links.reaction / inertia
    flow[2:, 2:] = links.A
    flow[2:, 0], flow[2:, 1] = links.B_position, links.B_velocity
    step = np.eye(len(flow)) + expm1(flow, interval)
    noise = np.zeros((2 * n + 2, 2 * n + 2))
    shaken = [1, *range(2 + n, 2 + 2 * n)]
    noise[shaken, shaken] = rate**4 * interval * interval
    gains[1] = _kalman(step, noise)
    return gains


def _kalman(step: Array, noise: Array) -> Array:
    """(s,) stationary gains of a filter that measures the first state with a variance of 1, by doubling the time."""
    size = len(step)
    forwards, backwards, spread = step.T.copy(), np.zeros((size, size)), noise.copy()
    backwards[0, 0] = 1.0
    for _ in range(_DOUBLINGS):
        inner = np.linalg.inv(np.eye(size) + backwards @ spread)
        spread, backwards, forwards = (
            spread + forwards.T @ spread @ inner @ forwards,
            backwards + forwards @ inner @ backwards @ forwards.T,
            forwards @ inner @ forwards,
        )
    return np.asarray(spread[:, 0] / (spread[0, 0] + 1.0))
