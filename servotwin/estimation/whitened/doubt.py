"""Spread of the gap over other explanations of a window: machines and sensors that are not as assumed.

Each explanation adds a motion of a usual size to the fit: another stiffness, a soft screw, a ramp of the gap, a sensor
that lags, one that errs once per turn. It moves the gap, and leaves it less well known. How much that counts depends on
how likely the window makes it, by the marginal likelihood (Bayes' factor): what the window contradicts costs nothing,
what it shows or does not tell from the gap costs all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servotwin.estimation.whitened.free_model import COMPLIANCE, CYCLIC, FREEDOM, FreeProblem
from servotwin.plant.signals import Array

_ODDS = math.exp(2.0)  # of each explanation beforehand: real machines and sensors err in some way
_LEAST = 1e-12  # of a column's square
_PLACE = 1  # row of the derivative by the place


def gap_doubt(problem: FreeProblem, at: Array, variance: float, delay: float, ramp: float, learnt: bool) -> float:
    """Root mean square (rad) of the changes of a fitted gap by other explanations of its window.

    Parameters
    ----------
    problem : FreeProblem
    at : (6,) array
        The fit's gap (rad), place and factors.
    variance : float
        Of the residual in units of the noise, at least 1.
    delay : float
        s, by which the position is late.
    ramp : float
        rad/s, usual size of a ramp of the gap.
    learnt : bool
        True: the factors are free in any case; otherwise each is an explanation of its own.
    """
    residual, rows = _explained(problem, delay, ramp).rows(at, keep=True)
    first = 2 + len(FREEDOM)
    if learnt:
        known, factors = first, []
    else:
        known, factors = 2, [[index] for index in range(2, first)]
        rows[2:first] *= np.array(FREEDOM)[:, None]
    return spread_over(residual, rows, known, [*factors, *_groups(first, delay, ramp)], variance)


def way_doubt(problem: FreeProblem, at: Array, variance: float, delay: float, ramp: float) -> float:
    """The same of the motor's way to the only contact of a window, in a gap so wide that it has no other.

    Gap and place act alike there, through this way; 0 where the motor is in contact from the first sample on.
    """
    residual, rows = _explained(problem, delay, ramp).rows(at, keep=True)
    if not np.any(rows[_PLACE]):
        return 0.0
    rows[_PLACE] /= 0.5 * at[0]
    known = 1 + len(FREEDOM)
    return spread_over(residual, rows[_PLACE:], known, _groups(known, delay, ramp), variance)


def _explained(problem: FreeProblem, delay: float, ramp: float) -> FreeProblem:
    """The problem with all other explanations."""
    return replace(problem, compliance=COMPLIANCE, delay=delay, cyclic=CYCLIC, ramp=ramp)


def _groups(first: int, delay: float, ramp: float) -> list[list[int]]:
    """Rows of the explanations, which begin at row `first`."""
    sizes = [*([1] if delay == 0.0 else [1, 1]), 2, 2, *([1] if ramp > 0.0 else [])]
    ends = first + np.cumsum(sizes)
    return [list(range(end - size, end)) for end, size in zip(ends.tolist(), sizes, strict=True)]


def spread_over(residual: Array, rows: Array, known: int, groups: Sequence[Sequence[int]], variance: float) -> float:
    """Root mean square (rad) of the changes of the gap by other explanations, each weighted by its probability.

    Parameters
    ----------
    residual : (M,) array
        Whitened.
    rows : (k, M) array
        Derivatives by gap (rad), by what else is free in any case, and by the explanations' sizes. Each size is 0 with
        a standard deviation of 1, which is part of the rows.
    known : int
        Rows that are free in any case, the gap first.
    groups : sequence of sequences of int
        Rows of each explanation.
    variance : float
        Of the residual.
    """
    size = np.sqrt(np.sum(rows * rows, axis=1))
    use = np.flatnonzero(size[:known] > 0.0)
    first, others = rows[use] / size[use, None], rows[known:]
    products = first @ first.T + _LEAST * np.eye(use.size)
    onto = np.linalg.solve(products, first @ np.vstack([others, residual]).T)
    left = np.vstack([others, residual]) - onto.T @ first
    information, pull = left[:-1] @ left[:-1].T, left[:-1] @ left[-1]
    by_size = -onto[0, :-1] / size[0]
    total = 0.0
    for group in groups:
        index = np.array(group) - known
        own = information[np.ix_(index, index)]
        shares, spread = np.linalg.solve(own, pull[index]), np.linalg.solve(own, by_size[index])
        # Rows contain what is expected of the sizes: each is 1 at least.
        evidence = 0.5 * float(pull[index] @ shares) / variance - 0.5 * float(np.linalg.slogdet(own)[1])
        likely = 1.0 / (1.0 + math.exp(-min(max(evidence, -100.0), 100.0)) / _ODDS)
        total += likely * (float(by_size[index] @ shares) ** 2 + variance * float(by_size[index] @ spread))
    return math.sqrt(total)
