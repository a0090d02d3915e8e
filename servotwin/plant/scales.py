"""A servo's own second, metre and volt: the units in which defaults are counted that have a dimension.

Such defaults (how long a rest must be, how slow a motion counts as slow) were chosen on the paper's servo. A servo that
is the same machine in other units (slower, larger, on another voltage) gets the same criteria in its own units, and
thereby the same verdicts.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo

# Of the loop's own time: the paper's structure is slower than that, with the gains of every preset; a stiff one is not.
_LOOP = 0.1


class Scales(NamedTuple):
    """Units of a servo over those of the preset `paper`.

    Attributes
    ----------
    time : float
        Slowness of the structure, or of the loop where that is much slower than the structure.
    length : float
        Travel of the screw per angle.
    voltage : float
        Back EMF of one radian in this time.
    """

    time: float
    length: float
    voltage: float


@lru_cache(maxsize=64)
def scales(servo: Plant) -> Scales:
    """Units of a servo with its own controller; (1, 1, 1) for the preset `paper`."""
    own, paper = _units(servo), _paper()
    return Scales(own.time / paper.time, own.length / paper.length, own.voltage / paper.voltage)


def structure_time(servo: Servo) -> float:
    """A servo's own second by its structure alone, whatever its loop: that of `scales` or less; 0 of one mass."""
    return _passing(servo) / _paper().time


@cache
def _paper() -> Scales:
    return _units(Servo.preset("paper"))


def _units(servo: Plant) -> Scales:
    """The same in s, m/rad and V/rad.

    A motion needs sqrt(m / k) to pass from one mass to the next, and a stiff machine's loop k_B / (Kp p) to follow: of
    an axis one over its first gain crossover, and its unit of the command is that of one radian in this time.
    """
    if isinstance(servo, Axis):
        return _units_of_axis(servo)
    time = _passing(servo)
    if servo.controller.Kp != 0.0:
        time = max(time, _LOOP * servo.k_B / (abs(servo.controller.Kp) * servo.p))
    return Scales(time, servo.p, servo.k_B / time)


def _passing(servo: Servo) -> float:
    """Time (s) in which a motion passes from the screw to the last mass."""
    return float(np.sum(np.sqrt(servo.masses[1:] / servo.stiffnesses[1:])))


def _units_of_axis(axis: Axis) -> Scales:
    time = float(np.sum(np.sqrt(axis.load.masses[1:] / axis.load.stiffnesses[1:])))
    if not axis.rigid:
        time += math.sqrt(axis.load.m[0] / axis.transmission.k_d)
    crossovers = axis.margins().gain_crossovers
    if crossovers:
        time = max(time, _LOOP / crossovers[0].omega)
    if time == 0.0:
        # A stiff axis whose loop is slower than any crossover has the time of its actuator.
        time = 1.0 / float(np.max(np.abs(np.linalg.eigvals(axis.shaft().A))))
    shaft = axis.actuator.polynomials()
    turned = complex(np.polyval(shaft.command[::-1], 1j / time) / np.polyval(shaft.shaft[::-1], 1j / time))
    return Scales(time, axis.p, 1.0 / abs(turned))
