"""Bounded Levenberg-Marquardt in any named parameters of the joint model, with what is known of them beforehand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.core.projection import spread
from servotwin.estimation.joint.model import JointModel, Reduce
from servotwin.plant.signals import Array

Flags: TypeAlias = NDArray[np.bool_]
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e-10, 1e9
_SINGULAR = 1e-8  # of a derivative's length: what the others leave of it below this is nothing
_SMALL_GAIN = 1e-6  # of the cost: a step that gains less is the last; whitened, far below one standard deviation


@dataclass(frozen=True, eq=False)
class Known:
    """Bounds and prior of each parameter, (P,) each, in the model's order; spread inf: nothing is known."""

    lowest: Array
    highest: Array
    mean: Array
    spread: Array

    def vague(self, kept: Flags) -> Known:
        """The bounds alone, and parameters that are not `kept` (P,) held at their means: for a first search."""
        lowest, highest = np.where(kept, self.lowest, self.mean), np.where(kept, self.highest, self.mean)
        return Known(lowest, highest, self.mean, np.full_like(self.spread, np.inf))


@dataclass(frozen=True, eq=False)
class Stand:
    """A point, and what holds there: residual and derivatives (P, m + P) with the prior as P more samples."""

    point: Array
    residual: Array
    jacobian: Array
    evaluations: int = 1
    converged: bool = False

    @property
    def cost(self) -> float:
        """Squared length of the residual."""
        return float(self.residual @ self.residual)

    def deviations(self) -> Array:
        """(P,) standard deviations for residuals of variance 1, all else unknown; inf where nothing is known."""
        rows = self.jacobian
        return np.array([spread(row, np.delete(rows, i, axis=0), _SINGULAR) for i, row in enumerate(rows)])

    def covariance(self) -> Array:
        """(P, P) covariance for residuals of variance 1; inf on the diagonal of what is not known."""
        scale = np.linalg.norm(self.jacobian, axis=1)
        scale[scale == 0.0] = 1.0
        scaled = self.jacobian / scale[:, None]
        covariance = np.linalg.pinv(scaled @ scaled.T, hermitian=True) / np.outer(scale, scale)
        np.fill_diagonal(covariance, self.deviations() ** 2)
        return covariance


Evaluate: TypeAlias = Callable[[Array], Stand]


def stand(model: JointModel, point: Array, known: Known, reduce: Reduce) -> Stand:
    """Evaluate at a point."""
    slopes = model.slopes(dict(zip(model.names, point.tolist(), strict=True)), reduce)
    prior = (point - known.mean) / known.spread
    jacobian = np.hstack([slopes.jacobian, np.diag(1.0 / known.spread)])
    return Stand(point, np.concatenate([slopes.residual, prior]), jacobian)


def descend(evaluate: Evaluate, start: Array, known: Known, tolerance: Array, steps: int = 40) -> Stand:
    """From a start (P,) to the nearest minimum; it ends when a step is below `tolerance` (P,) in each."""
    here, damping = evaluate(np.clip(start, known.lowest, known.highest)), _FIRST_DAMPING
    for count in range(2, steps):
        trial = np.clip(here.point + _step(here, known, damping), known.lowest, known.highest)
        if np.all(np.abs(trial - here.point) <= tolerance):
            return replace(here, evaluations=count, converged=True)
        ahead = evaluate(trial)
        if ahead.cost < here.cost:
            gained, here, damping = here.cost - ahead.cost, ahead, max(0.1 * damping, _LEAST_DAMPING)
            if gained <= _SMALL_GAIN * ahead.cost:
                return replace(here, evaluations=count, converged=True)
        else:
            damping *= 8.0
            if damping > _LARGEST_DAMPING:
                return replace(here, evaluations=count, converged=True)
    return replace(here, evaluations=steps)


def _step(here: Stand, known: Known, damping: float) -> Array:
    """The damped Gauss-Newton step of the parameters that are not held by their bounds."""
    downhill = -here.jacobian @ here.residual
    held = ((here.point <= known.lowest) & (downhill < 0.0)) | ((here.point >= known.highest) & (downhill > 0.0))
    size = np.linalg.norm(here.jacobian, axis=1)
    free = np.flatnonzero(~held & (size > 0.0))
    step = np.zeros_like(here.point)
    scaled = here.jacobian[free] / size[free, None]
    damped = scaled @ scaled.T + damping * np.eye(free.size)
    step[free] = np.linalg.solve(damped, downhill[free] / size[free]) / size[free]
    return step


def scan(model: JointModel, values: Mapping[str, float], gaps: Array, keep: int, reduce: Reduce) -> list[Array]:
    """The `keep` best starts (P,) of a grid of gaps (rad) and places, the other parameters as in `values`."""
    grid = [{**values, "gap": float(gap), "place": place} for gap in gaps for place in (-1.0, 0.0, 1.0)]
    costs = [model.cost(one, reduce) for one in grid]
    best = np.argsort(costs, kind="stable")[:keep]
    return [np.array([grid[i][name] for name in model.names]) for i in best]
