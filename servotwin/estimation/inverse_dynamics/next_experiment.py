"""The next experiment: of a few motions within what was seen, the one that tells most of the worst known parameter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion
from servotwin.estimation.inverse_dynamics.fit import ParameterFit, Rows
from servotwin.plant.signals import Array

_WANTED = 0.02  # half of the 95 % interval, relative
_STEPS = 400  # samples of a cycle
_SLOW = 10.0  # cruise of a slow stroke, over the time to the highest speed
_LONGEST = 1e7  # times that time
_WORDS = {
    "inertia": "the inertia",
    "viscous": "the viscous friction",
    "coulomb": "the Coulomb friction",
    "offset": "the constant force",
}


@dataclass(frozen=True)
class NextExperiment:
    """Advice from the covariance of a fit.

    Attributes
    ----------
    worst : str
        Parameter that is known worst, relative to itself; the offset relative to the Coulomb friction.
    half_width : float
        Half of its 95 % interval now, relative likewise.
    motion : str
        In words.
    duration : float
        s, until that is 2 %; 0 where it already is.
    """

    worst: str
    half_width: float
    motion: str
    duration: float

    def __str__(self) -> str:
        """One sentence."""
        known = f"by chance alone {_WORDS[self.worst]} is known worst, to ± {100.0 * self.half_width:.2g} % (95 %)"
        if self.duration == 0.0:
            return f"{known}: no further experiment is needed for ± {100.0 * _WANTED:g} %"
        seconds = float(f"{self.duration:.2g}")
        return (
            f"{known}; {self.motion}, for {seconds:g} s, would tell most of it and bring it to ± {100.0 * _WANTED:g} %"
        )


def next_experiment(fit: ParameterFit, rows: Rows, motion: DriveMotion, unit: str) -> NextExperiment:
    """Choose a motion by the information that it adds per second.

    The information of a motion is that of its regressors over the variance that the fit's covariance implies for its
    own rows; it takes errors to be of the same kind in the new motion.
    """
    scale = np.abs(fit.values)
    scale[3] = max(scale[3], scale[2])
    half_widths = np.array([fit.half_width(name) for name in fit.names])
    relative = half_widths / np.maximum(scale, np.finfo(float).tiny)
    place = int(np.argmax(relative))
    now = float(relative[place])
    if now <= _WANTED:
        return NextExperiment(fit.names[place], now, "", 0.0)
    gram = rows.design[:, :4].T @ rows.design[:, :4]
    # Errors hang together from row to row: the variance that explains the covariance found for this parameter.
    variance = float(fit.covariance[place, place] / np.linalg.inv(gram)[place, place])
    step = 1.0 / _rows_per_second(rows, motion)
    fastest, sharpest = (float(np.quantile(np.abs(each), 0.99)) for each in (motion.speed, motion.acceleration))
    best = min(
        (
            (_needed(fit, place, scale, information / (variance * step), fastest / sharpest), words)
            for words, information in _motions(fastest, sharpest, unit)
        ),
        key=lambda each: each[0],
    )
    return NextExperiment(fit.names[place], now, best[1], best[0])


def _rows_per_second(rows: Rows, motion: DriveMotion) -> float:
    return rows.force.size / max(motion.seconds, np.finfo(float).tiny)


def _needed(fit: ParameterFit, place: int, scale: Array, per_second: Array, shortest: float) -> float:
    """Duration of a motion until half of a parameter's 95 % interval is 2 %, s, at least `shortest`."""
    now = np.linalg.inv(fit.covariance)
    wanted = _WANTED * scale[place] * fit.std(fit.names[place]) / fit.half_width(fit.names[place])

    def enough(seconds: float) -> bool:
        total = np.linalg.inv(now + seconds * per_second)
        return bool(math.sqrt(total[place, place]) <= wanted)

    seconds = shortest
    while not enough(seconds) and seconds < _LONGEST * shortest:
        seconds *= 1.25
    return seconds


def _motions(fastest: float, sharpest: float, unit: str) -> list[tuple[str, Array]]:
    """Candidate motions in words up to a speed and an acceleration, and the mean information of their regressors."""
    slow = 0.05 * fastest
    speeds = (slow, 0.3 * fastest, fastest)

    def strokes(speed: float, acceleration: float, cruise: float) -> Array:
        """Information of strokes to and fro that accelerate, cruise for a time (s) and brake."""
        ramp = speed / acceleration
        time = np.linspace(0.0, 2.0 * ramp + cruise, _STEPS)
        profile = np.minimum(np.minimum(time, ramp), time[-1] - time) * acceleration
        push = np.where(time < ramp, acceleration, np.where(time > ramp + cruise, -acceleration, 0.0))
        ones = np.ones_like(time)
        there = np.column_stack([push, profile, ones, ones])
        rows = np.concatenate([there, there * np.array([-1.0, -1.0, -1.0, 1.0])])
        return np.asarray(rows.T @ rows / len(rows))

    several = sum((strokes(each, sharpest, 2.0 * fastest / sharpest) for each in speeds), np.zeros((4, 4))) / len(
        speeds
    )
    shown = ", ".join(f"{each:.2g}" for each in speeds)
    return [
        (f"slow strokes to and fro at {slow:.2g} {unit}/s", strokes(slow, sharpest, _SLOW * fastest / sharpest)),
        (f"long strokes to and fro at {fastest:.2g} {unit}/s", strokes(fastest, sharpest, 4.0 * fastest / sharpest)),
        (
            f"short strokes to and fro that accelerate at {sharpest:.2g} {unit}/s^2 throughout",
            strokes(fastest, sharpest, 0.0),
        ),
        (f"strokes to and fro at {shown} {unit}/s in turn", several),
    ]
