"""Fit of the states that a law had before a window, through the law itself: with its dead zone and its limits.

An integral that the dead zone hides shows only when the law acts, and where a limit then corrects it, less of it shows:
no response of the unlimited law says how much.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from servotwin.plant.signals import Array

_ROUNDS = 8  # fits at most: a limit of the command makes it linear in the states only piece by piece
_SMALL = 1e-5  # of the command, by which each state moves it for its response
_LINEAR = 1e-9  # of the command: what a step changes else than foretold
_AT_LIMIT = 0.999  # of the limit
_FARTHEST = 3.0  # largest commands by which a state may move the command

Run = Callable[[Array], Array]
"""Command (n,) of a law from first states (k,)."""


def command_from_best_states(run: Run, unlimited: Run, units: Array, recorded: Array, limit: float) -> Array:
    """Command (n,) of a law from the first states that fit the recorded one best.

    Parameters
    ----------
    run, unlimited : callable
        The law, and the law without its limits.
    units : (k,) array
        Of each state what moves the command by about its unit outside the dead zone.
    recorded : (n,) array
    limit : float
        Largest command; inf: none.
    """

    def scaled(values: Array) -> Array:
        return run(units * values)

    begin = np.zeros(units.size)
    given = unlimited(begin)
    small = _SMALL * (rms(recorded) or rms(given))
    if small == 0.0:
        return run(begin)
    columns = _columns(lambda values: unlimited(units * values), begin, given, small)
    # What fades in the dead zone would have to be vast to show behind it: it would then explain any command.
    farthest = _FARTHEST * max(float(np.max(np.abs(recorded))), float(np.max(np.abs(given))))
    # Where the law is at its limit all the time that it acts, no small change of its states shows.
    free = np.abs(recorded) < _AT_LIMIT * limit
    guessed = _within(columns[free], recorded[free] - given[free], begin, farthest)
    made = [_descended(scaled, states, small, recorded, farthest) for states in (guessed, begin)]
    return min(made, key=lambda command: rms(recorded - command))


def _descended(run: Run, states: Array, small: float, recorded: Array, farthest: float) -> Array:
    """Command (n,) of a law from the states that fit the recorded one best beside given ones."""
    given = run(states)
    columns = _columns(run, states, given, small)
    for _ in range(_ROUNDS):
        after = _within(columns, recorded - given, states, farthest)
        foretold = given + columns @ (after - states)
        made = run(after)
        if rms(recorded - made) >= rms(recorded - given):
            return given
        if rms(made - foretold) <= _LINEAR * rms(recorded):
            return made
        states, given, columns = after, made, _columns(run, after, made, small)
    return given


def _within(columns: Array, target: Array, states: Array, farthest: float) -> Array:
    """States (k,) of at most a size whose distance from given ones fits a target (n,) best."""
    after = states + least_squares(columns, target)
    if np.all(np.abs(after) <= farthest):
        return after
    # Here, because scipy.optimize takes long to import and most windows need none of it.
    from scipy.optimize import lsq_linear

    orthogonal, triangle = np.linalg.qr(columns)
    bounds = -farthest - states, farthest - states
    return np.asarray(states + lsq_linear(triangle, orthogonal.T @ target, bounds, method="bvls").x)


def _columns(run: Run, states: Array, given: Array, small: float) -> Array:
    """Change (n, k) of the command `given` from some states per unit of each of them."""
    return np.stack([(run(states + each) - given) / small for each in small * np.eye(states.size)], axis=1)


def least_squares(columns: Array, target: Array) -> Array:
    """Coefficients (k,) of the columns (n, k), whose units differ by orders of magnitude."""
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / size, target, rcond=1e-9)[0] / size)


def rms(values: Array) -> float:
    """Root mean square of values."""
    return math.sqrt(np.mean(np.square(values)))
