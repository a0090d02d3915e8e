"""Fit of a model's unknowns to a window: Levenberg-Marquardt in whitened noise. `search` says where it begins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.output_error.models import HALF, FittedModel, Flags
from servotwin.plant.signals import Array

_ORDER = 24  # of the noise's autoregression
_STEP = 1e-6  # of an unknown's size: difference that makes a derivative
_SINGLE_STEPS = 8
_HARDLY = 1e-3  # of the whole residual: what an unknown of usual size shows that is held back first
_GAIN = 1e-3  # of the residual's variance: what a step must promise
_ROUNDING = 0.6  # of a count: what is left where rounding is all of the noise
_FLOOR = 1e-3  # of half the gap: the model's own error, which is no noise to learn


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum.

    Attributes
    ----------
    values : (u,) array
        Of the unknowns.
    residual : (M,) array
        Whitened, prior at the end.
    rows : (u, M) array
        Derivatives of the residual.
    cost : float
    raw : (m,) array
        Position of the model less the measured one, m or rad.
    evaluations : int
    """

    values: Array
    residual: Array
    rows: Array
    cost: float
    raw: Array
    evaluations: int

    def variance(self) -> float:
        """Of the whitened residual; at least 1."""
        return max(1.0, self.cost / max(1, self.raw.size - self.values.size))

    def std(self, which: int, free: Flags) -> float:
        """Standard deviation of an unknown beside the other free ones; inf where nothing shows it."""
        places = np.flatnonzero(free)
        size = np.linalg.norm(self.rows[places], axis=1)
        places, size = places[size > 0.0], size[size > 0.0]
        if which not in places:
            return math.inf
        scaled = self.rows[places] / size[:, None]
        values, vectors = np.linalg.eigh(scaled @ scaled.T)
        at = int(np.flatnonzero(places == which)[0])
        share = vectors[at] ** 2
        if np.any(share[values <= 1e-12 * values[-1]] > 1e-6):
            return math.inf
        good = values > 1e-12 * values[-1]
        return float(math.sqrt(np.sum(share[good] / values[good]) * self.variance()) / size[at])


class FitProblem(Protocol):
    """A window and a model of it: `Problem`, or the one of `servotwin.estimation.motor_side`.

    Its first unknown is the half gap at the load. `sizes` (u,) are usual sizes of the unknowns, `limits` (u,) their
    largest ones, `misfit` (m,) is what the model leaves, `misfits` the same of several points, `grid` and
    `on_one_flank` are those of `Problem`.
    """

    @property
    def model(self) -> FittedModel: ...
    @property
    def drive(self) -> Array: ...
    @property
    def position(self) -> Array: ...
    @property
    def interval(self) -> float: ...
    @property
    def count(self) -> float: ...
    @property
    def duration(self) -> float: ...
    @property
    def range(self) -> float: ...
    @property
    def free(self) -> Flags: ...
    def sizes(self) -> Array: ...
    def limits(self) -> Array: ...
    def misfit(self, values: Array, rate: float = 0.0) -> Array: ...
    def misfits(self, points: list[Array], rate: float = 0.0) -> list[Array]: ...
    def grid(self, gap: float) -> list[list[Array]]: ...
    def on_one_flank(self, values: Array) -> list[list[Array]]: ...


def whitened_rows(
    problem: FitProblem,
    values: Array,
    noise: Autoregression,
    free: Flags,
    rate: float = 0.0,
    misfit: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Whitened residual (M,) and its derivatives (u, M), the prior's at the end, and the `misfit`, known or not."""
    steps, raw = _STEP * problem.sizes(), problem.misfit(values, rate) if misfit is None else misfit
    table = np.zeros((values.size + 1, raw.size))
    table[0] = raw
    places = np.flatnonzero(free)
    moved = values + np.diag(steps)[places]
    for i, other in zip(places, problem.misfits(list(moved), rate), strict=True):
        table[i + 1] = (other - raw) / steps[i]
    white = noise.whiten(table)
    root = problem.model.root
    rows = np.hstack([white[1:], root.T * free[:, None]])
    return np.concatenate([white[0], root @ values]), rows, raw


def descend(
    problem: FitProblem,
    start: Array,
    noise: Autoregression,
    free: Flags,
    steps: int,
    rate: float = 0.0,
    least_gain: float = 0.0,
) -> Fit:
    """Levenberg-Marquardt from a start; only `free` (u,) unknowns move.

    It ends where a step promises less than a share `least_gain` of the cost, or a small one of the noise's variance.
    """
    most, usual = problem.limits(), problem.sizes()
    least = np.where([unknown.positive for unknown in problem.model.unknowns], 0.0, -most)
    values, damping = np.clip(start, least, most), 1e-3
    residual, rows, raw = whitened_rows(problem, values, noise, free, rate)
    cost, count = float(residual @ residual), 1
    for _ in range(steps):
        size, uphill = np.linalg.norm(rows, axis=1), rows @ residual
        held = ((values <= least) & (uphill > 0.0)) | ((values >= most) & (uphill < 0.0))
        use = np.flatnonzero(free & (size > 0.0) & ~held)
        # Without this an unknown that hardly shows would go far beyond what its derivative says of it.
        size = np.maximum(size, _HARDLY * math.sqrt(cost) / usual)
        scaled = rows[use] / size[use, None]
        matrix, downhill = scaled @ scaled.T, scaled @ residual
        better = False
        while damping < 1e6 and not better:
            step = np.zeros(values.size)
            step[use] = -np.linalg.solve(matrix + damping * np.eye(use.size), downhill) / size[use]
            ahead = np.clip(values + step, least, most)
            ahead[HALF] = abs(ahead[HALF])
            move = (ahead - values) @ rows
            if -float(move @ (2.0 * residual + move)) <= max(_GAIN / residual.size, least_gain) * cost:
                return Fit(values, residual, rows, cost, raw, count)
            misfit = problem.misfit(ahead, rate)
            white = noise.whiten(misfit[None])[0]
            prior = problem.model.root @ ahead
            after, count = float(white @ white + prior @ prior), count + 1
            better = after < cost
            damping = max(1e-9, 0.1 * damping) if better else 10.0 * damping
        if not better:
            break
        values = ahead
        residual, rows, raw = whitened_rows(problem, values, noise, free, rate, misfit)
        cost = float(residual @ residual)
    return Fit(values, residual, rows, cost, raw, count)


def only_rounding(problem: FitProblem, fit: Fit) -> bool:
    """Tell whether rounding explains what the fit of a motion without dynamics leaves."""
    return problem.model.speed == 0.0 and float(np.std(fit.raw)) < _ROUNDING * problem.count


def noise_in(problem: FitProblem, fit: Fit) -> Autoregression:
    """Noise that a fit leaves, no quieter than the model's own error.

    Rounding of a motion without dynamics has no spectrum that is worth learning: one that was learnt at a wrong minimum
    spoke for it.
    """
    floor = max(_FLOOR * fit.values[HALF], 1e-9 * problem.range, 1e-300)
    if only_rounding(problem, fit):
        return Autoregression.white(max(floor, float(np.std(fit.raw)), problem.count / math.sqrt(12.0)))
    dither = np.random.default_rng(0).normal(0.0, floor, fit.raw.size)
    return burg((fit.raw + dither)[None], min(_ORDER, fit.raw.size // 10))


@dataclass(frozen=True, eq=False)
class Search:
    """The best fit of a window, and the other minima in its noise.

    Attributes
    ----------
    problem : FitProblem
    noise : Autoregression
    best : Fit
    others : tuple of Fit
    free : (u,) array of bool
    """

    problem: FitProblem
    noise: Autoregression
    best: Fit
    others: tuple[Fit, ...]
    free: Flags


def plain_cost(problem: FitProblem, values: Array, rate: float = 0.0) -> float:
    """Sum of squares of the misfit."""
    raw = problem.misfit(values, rate)
    with np.errstate(over="ignore"):
        # A load that runs away from its motor costs more than any number.
        return float(raw @ raw)


def one_flank(found: Search) -> Fit:
    """The best fit of a window in which the motor touches one flank only."""
    return min((fit for fits in on_each_flank(found) for fit in fits), key=lambda fit: fit.cost)


def on_each_flank(found: Search) -> tuple[list[Fit], list[Fit]]:
    """Fits with the lower and with the upper flank only.

    The gap is so wide that the other flank is out of reach, and fixed.
    """
    problem, free = found.problem, found.free.copy()
    free[HALF] = False
    best, rate = [], problem.model.slowing[1] * problem.model.speed
    for tried in problem.on_one_flank(found.best.values):
        costs = [plain_cost(problem, values, rate) for values in tried]
        start = tried[int(np.argmin(costs))]
        best.append(descend(problem, start, found.noise, free, _SINGLE_STEPS, rate))
    return best[: len(best) // 2], best[len(best) // 2 :]
