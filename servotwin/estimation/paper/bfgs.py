"""Unconstrained BFGS with a cubic line search, for a few parameters of a cheap cost (the paper's choice, section 4.1).

scipy's does the same, but spends milliseconds on its own bookkeeping where the cost takes microseconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from servotwin.plant.signals import Array

Slope: TypeAlias = Callable[[Array], tuple[float, Array]]
_SUFFICIENT, _CURVATURE = 1e-4, 0.9  # strong Wolfe conditions, the usual values
_TRIALS = 12


@dataclass(frozen=True)
class Minimum:
    """End of a minimisation.

    A point from which the gradient leads to no lower cost, however short the step, counts as converged: it is a corner
    of the cost, or its rounding.

    Attributes
    ----------
    point : (n,) array
    cost : float
    converged : bool
    evaluations : int
        Of cost and gradient together.
    message : str
        Why it stopped.
    """

    point: Array
    cost: float
    converged: bool
    evaluations: int
    message: str


@dataclass(frozen=True)
class _Trial:
    step: float
    cost: float
    slope: float
    point: Array
    gradient: Array


def minimise(
    evaluate: Slope, start: Array, gradient_tolerance: float, step_tolerance: float, iterations: int = 100
) -> Minimum:
    """Minimise a cost from `start`.

    Parameters
    ----------
    evaluate : callable
        point (n,) -> (cost, gradient (n,)). Scale the problem so that its second derivatives are near one: the first
        step is the negative gradient.
    start : (n,) array
    gradient_tolerance, step_tolerance : float
        It has converged when no component of the gradient, or of a step, exceeds these.
    iterations : int
    """
    count = 0

    def counted(point: Array) -> tuple[float, Array]:
        nonlocal count
        count += 1
        return evaluate(point)

    cost, gradient = counted(start)
    here = _Trial(0.0, cost, 0.0, start, gradient)
    inverse, fresh = np.eye(start.size), True
    for _ in range(iterations):
        if float(np.abs(here.gradient).max()) <= gradient_tolerance:
            return Minimum(here.point, here.cost, True, count, "the gradient vanished")
        ahead, regular = _search(counted, here, -inverse @ here.gradient)
        moved, turned = ahead.point - here.point, ahead.gradient - here.gradient
        here = ahead
        if regular and float(np.abs(moved).max()) <= step_tolerance:
            return Minimum(here.point, here.cost, True, count, "the step vanished")
        if not regular and fresh:
            return Minimum(here.point, here.cost, True, count, "no lower cost lies down the gradient")
        inverse = _updated(inverse, moved, turned, fresh) if regular else np.eye(start.size)
        fresh = not regular
    return Minimum(here.point, here.cost, False, count, f"no convergence in {iterations} iterations")


def _updated(inverse: Array, moved: Array, turned: Array, fresh: bool) -> Array:
    """The BFGS update of the inverse Hessian; unchanged where the curvature along the step was not positive."""
    curvature = float(moved @ turned)
    if curvature <= 1e-12 * float(np.linalg.norm(moved) * np.linalg.norm(turned)):
        return inverse
    if fresh:
        inverse = inverse * (curvature / float(turned @ turned))
    shear = np.eye(moved.size) - np.outer(moved, turned) / curvature
    return shear @ inverse @ shear.T + np.outer(moved, moved) / curvature


def _search(evaluate: Slope, here: _Trial, direction: Array) -> tuple[_Trial, bool]:
    """A point along `direction` that meets the strong Wolfe conditions and True, else the lowest trial and False."""

    def trial(step: float) -> _Trial:
        point = here.point + step * direction
        cost, gradient = evaluate(point)
        return _Trial(step, cost, float(gradient @ direction), point, gradient)

    origin = _Trial(0.0, here.cost, float(here.gradient @ direction), here.point, here.gradient)
    low, high, step = origin, None, 1.0
    for _ in range(_TRIALS):
        new = trial(step)
        if new.cost > origin.cost + _SUFFICIENT * step * origin.slope or new.cost >= low.cost:
            high = new
        elif abs(new.slope) <= -_CURVATURE * origin.slope:
            return new, True
        else:
            if new.slope * (1.0 if high is None else high.step - low.step) >= 0.0:
                high = low
            low = new
        step = 2.5 * step if high is None else _between(low, high)
    return low, False


def _between(low: _Trial, high: _Trial) -> float:
    """Minimiser of the cubic through both ends' costs and slopes, kept off the ends."""
    span = high.step - low.step
    bend = low.slope + high.slope - 3.0 * (high.cost - low.cost) / span
    inside = bend * bend - low.slope * high.slope
    share = 0.5
    if inside >= 0.0:
        root = math.copysign(math.sqrt(inside), span)
        bottom = high.slope - low.slope + 2.0 * root
        if bottom != 0.0:
            share = 1.0 - (high.slope + root - bend) / bottom
    return low.step + span * min(max(share, 0.05), 0.95)
