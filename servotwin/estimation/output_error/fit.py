"""Fit of a model's unknowns to a window: search over gap and offset, then Levenberg-Marquardt in whitened noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.output_error.models import HALF, FittedModel, Flags
from servotwin.plant.signals import Array

_ORDER = 24  # of the noise's autoregression
_PASSES = 3
_STEP = 1e-6  # of an unknown's size: difference that makes a derivative
_FIRST, _SECOND = 4, 2  # minima that are followed in white noise, and in the window's own
_SINGLE_STEPS = 8
_ROUNDED_STEPS = 20
_AGAIN = ((3, 3), (10, 2))  # steps in the noise that was learnt, from each start of the grid, and minima kept
_SAME = 0.02  # of a gap: minima that are one
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
    largest ones, `misfit` (m,) is what the model leaves, `grid` and `on_one_flank` are those of `Problem`.
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
    def grid(self, gap: float) -> list[list[Array]]: ...
    def on_one_flank(self, values: Array) -> list[list[Array]]: ...


def whitened_rows(
    problem: FitProblem, values: Array, noise: Autoregression, free: Flags, rate: float = 0.0
) -> tuple[Array, Array, Array]:
    """Whitened residual (M,) and its derivatives (u, M), the prior's at the end, and the misfit."""
    steps, raw = _STEP * problem.sizes(), problem.misfit(values, rate)
    table = np.zeros((values.size + 1, raw.size))
    table[0] = raw
    for i in np.flatnonzero(free):
        moved = values.copy()
        moved[i] += steps[i]
        table[i + 1] = (problem.misfit(moved, rate) - raw) / steps[i]
    white = noise.whiten(table)
    root = problem.model.root
    rows = np.hstack([white[1:], root.T * free[:, None]])
    return np.concatenate([white[0], root @ values]), rows, raw


def descend(
    problem: FitProblem, start: Array, noise: Autoregression, free: Flags, steps: int, rate: float = 0.0
) -> Fit:
    """Levenberg-Marquardt from a start; only `free` (u,) unknowns move."""
    most = problem.limits()
    least = np.where([unknown.positive for unknown in problem.model.unknowns], 0.0, -most)
    values, damping = np.clip(start, least, most), 1e-3
    residual, rows, raw = whitened_rows(problem, values, noise, free, rate)
    cost, count = float(residual @ residual), 1
    for _ in range(steps):
        size = np.linalg.norm(rows, axis=1)
        uphill = rows @ residual
        held = ((values <= least) & (uphill > 0.0)) | ((values >= most) & (uphill < 0.0))
        use = np.flatnonzero(free & (size > 0.0) & ~held)
        scaled = rows[use] / size[use, None]
        matrix, downhill = scaled @ scaled.T, scaled @ residual
        better = False
        while damping < 1e6 and not better:
            step = np.zeros(values.size)
            step[use] = -np.linalg.solve(matrix + damping * np.eye(use.size), downhill) / size[use]
            ahead = np.clip(values + step, least, most)
            ahead[HALF] = abs(ahead[HALF])
            move = (ahead - values) @ rows
            if -float(move @ (2.0 * residual + move)) <= _GAIN * cost / residual.size:
                return Fit(values, residual, rows, cost, raw, count)
            white = noise.whiten(problem.misfit(ahead, rate)[None])[0]
            prior = problem.model.root @ ahead
            after, count = float(white @ white + prior @ prior), count + 1
            better = after < cost
            damping = max(1e-9, 0.1 * damping) if better else 10.0 * damping
        if not better:
            break
        values = ahead
        residual, rows, raw = whitened_rows(problem, values, noise, free, rate)
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


def starts(problem: FitProblem, gap: float) -> list[Array]:
    """Unknowns (u,) of a grid of gaps and offsets, the best ones of different gaps first.

    Parameters
    ----------
    problem : FitProblem
    gap : float
        Half gap at the load that is expected; 0: none.
    """
    best = []
    for tried in problem.grid(gap):
        costs = [_plain(problem, values, problem.model.speed) for values in tried]
        best.append((min(costs), tried[int(np.argmin(costs))]))
    return [values for _, values in sorted(best, key=lambda pair: pair[0])]


def _plain(problem: FitProblem, values: Array, rate: float = 0.0) -> float:
    raw = problem.misfit(values, rate)
    with np.errstate(over="ignore"):
        # A load that runs away from its motor costs more than any number.
        return float(raw @ raw)


def _distinct(fits: list[Fit]) -> list[Fit]:
    """Fits in different gaps, the best of each."""
    chosen: list[Fit] = []
    for fit in fits:
        if all(abs(fit.values[HALF] - one.values[HALF]) > _SAME * one.values[HALF] for one in chosen):
            chosen.append(fit)
    return chosen


def search(problem: FitProblem, gap: float) -> Search:
    """Fit a window: `gap` as in `starts`."""
    free, speed = problem.free, problem.model.speed
    rounded = _in_rounding(problem, gap)
    if rounded is not None:
        return rounded
    tried = starts(problem, gap)[:_FIRST]
    rough = math.sqrt(_plain(problem, tried[0], speed) / problem.position.size)
    noise = Autoregression.white(max(0.3 * rough, 1e-9 * problem.range))
    fits = [descend(problem, values, noise, free, 10, speed) for values in tried]
    fits = _distinct(sorted(fits, key=lambda fit: fit.cost))[:_SECOND]
    noise = noise_in(problem, fits[0])
    fits = [descend(problem, fit.values, noise, free, 8, problem.model.slowing[0] * speed) for fit in fits]
    fits.sort(key=lambda fit: fit.cost)
    rate = problem.model.slowing[1] * speed
    for _ in range(_PASSES):
        best = fits[0]
        noise = noise_in(problem, best)
        fits = [descend(problem, fit.values, noise, free, 10, rate) for fit in _distinct(fits)[:_SECOND]]
        fits.sort(key=lambda fit: fit.cost)
    again = _from_anew(problem, noise, free, gap)
    if again[0].cost < fits[0].cost:
        # The noise was learnt from what a worse minimum had left.
        noise = noise_in(problem, again[0])
        again = [descend(problem, fit.values, noise, free, 10, rate) for fit in _distinct(again)[:_SECOND]]
        fits = [descend(problem, fit.values, noise, free, 10, rate) for fit in fits]
    fits = _distinct(sorted([*fits, *again], key=lambda fit: fit.cost))
    return Search(problem, noise, fits[0], tuple(fits[1:]), free)


def _in_rounding(problem: FitProblem, gap: float) -> Search | None:
    """Fit of a window in errors of rounding; None where they do not explain it, and other noise is to be learnt."""
    if problem.model.speed > 0.0 or problem.count == 0.0:
        return None
    noise = Autoregression.white(problem.count / math.sqrt(12.0))
    fits = [descend(problem, values, noise, problem.free, _ROUNDED_STEPS) for values in starts(problem, gap)]
    fits = _distinct(sorted(fits, key=lambda fit: fit.cost))
    return Search(problem, noise, fits[0], tuple(fits[1:]), problem.free) if only_rounding(problem, fits[0]) else None


def _from_anew(problem: FitProblem, noise: Autoregression, free: Flags, gap: float) -> list[Fit]:
    """Minima from the grid of starts in the noise that was learnt, the best first.

    Minima that were followed from white noise on can have led the model's numbers astray: these begin at its own.
    """
    rate = problem.model.slowing[1] * problem.model.speed
    tried = starts(problem, gap)
    for steps, kept in _AGAIN:
        fits = [descend(problem, values, noise, free, steps, rate) for values in tried]
        fits = _distinct(sorted(fits, key=lambda fit: fit.cost))[:kept]
        tried = [fit.values for fit in fits]
    return fits


def one_flank(found: Search) -> Fit:
    """The best fit of a window in which the motor touches one flank only.

    The gap is so wide that the other flank is out of reach, and fixed.
    """
    problem, free = found.problem, found.free.copy()
    free[HALF] = False
    best, rate = [], problem.model.slowing[1] * problem.model.speed
    for tried in problem.on_one_flank(found.best.values):
        costs = [_plain(problem, values, rate) for values in tried]
        start = tried[int(np.argmin(costs))]
        best.append(descend(problem, start, found.noise, free, _SINGLE_STEPS, rate))
    return min(best, key=lambda fit: fit.cost)
