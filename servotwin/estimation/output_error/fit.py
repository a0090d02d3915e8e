"""Fit of a model's unknowns to a window: search over gap and offset, then Levenberg-Marquardt in whitened noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.output_error.models import DELAY, HALF, OFFSET, RATIO, Motion, MotionModel
from servotwin.plant.signals import Array

_ORDER = 24  # of the noise's autoregression
_PASSES = 3
_STEP = 1e-6  # of an unknown's size: difference that makes a derivative
_LARGEST = 4.0  # standard deviations by which an unknown may move
_LARGEST_DELAY = 0.03  # of the window
_HALVES = (0.5, 0.4, 0.3, 0.22, 0.15, 0.1, 0.06, 0.03, 0.015, 0.005)  # of the lead's range
_PLACES = tuple(0.1 * step for step in range(-5, 6))  # of the lead's range
_FIRST, _SECOND = 4, 2  # minima that are followed in white noise, and in the window's own
_WIDE, _SINGLE_STEPS = 5.0, 8  # of the lead's range
_SLOWER, _SLOWEST = (0.5,), 0.15  # speeds of the observer over its first
_AGAIN = ((3, 3), (10, 2))  # steps in the noise that was learnt, from each start of the grid, and minima kept
_SAME = 0.02  # of a gap: minima that are one
_GAIN = 1e-3  # of the residual's variance: what a step must promise
_FLOOR = 1e-3  # of half the gap: the model's own error, which is no noise to learn
_MOVED = 0.02  # of the window: what shows the first speed


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

    def std(self, which: int, free: Array) -> float:
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


@dataclass(frozen=True, eq=False)
class Problem:
    """A window and a model of it.

    Attributes
    ----------
    model : MotionModel
    drive, position : (N,) arrays
        Motor's angle times the transmission's ratio, and measured position; m or rad.
    interval : float
        s.
    count : float
        One count of either channel, seen at the load.
    """

    model: MotionModel
    drive: Array
    position: Array
    interval: float
    count: float

    @property
    def lead(self) -> Array:
        """(N,) motor before the load."""
        return np.asarray(self.drive - self.position)

    @property
    def range(self) -> float:
        """Of the lead."""
        return float(np.ptp(self.lead))

    @property
    def margin(self) -> int:
        """Samples at either end that do not count, because of the delay."""
        return 1 + math.ceil(self.largest_delay / self.interval)

    @property
    def largest_delay(self) -> float:
        """s."""
        known = _LARGEST * self.model.unknowns[DELAY].std
        return min(known, _LARGEST_DELAY * self.interval * self.drive.size)

    def sizes(self) -> Array:
        """(u,) usual sizes of the unknowns."""
        own = self.interval * self.drive.size
        sizes = {"load": self.range, "speed": self.range / own, "time": self.interval, "factor": 1.0, "damping": 1.0}
        return np.array([sizes[unknown.unit] for unknown in self.model.unknowns])

    def limits(self) -> Array:
        """(u,) largest sizes of the unknowns."""
        limits = np.array([_LARGEST * unknown.std for unknown in self.model.unknowns])
        limits[DELAY] = self.largest_delay
        return limits

    def motion(self, values: Array, rate: float = 0.0) -> Motion:
        """Simulate the window; `rate` (1/s) of the observer, 0: none.

        The motor's angle is delayed in place of the position: the load's motion begins with the first sample.
        """
        drive = _delayed(self.drive, float(values[DELAY]) / self.interval)
        return self.model.simulate(drive, self.position, self.interval, values, rate)

    def misfit(self, values: Array, rate: float = 0.0) -> Array:
        """(m,) position of the model, predicted by the observer if there is one, less the measured one."""
        part = slice(self.margin, self.drive.size - self.margin)
        return np.asarray((self.motion(values, rate).position - self.position)[part])

    def rows(self, values: Array, noise: Autoregression, free: Array, rate: float = 0.0) -> tuple[Array, Array, Array]:
        """Whitened residual (M,) and its derivatives (u, M), the prior's at the end, and the misfit."""
        steps, raw = _STEP * self.sizes(), self.misfit(values, rate)
        table = np.zeros((values.size + 1, raw.size))
        table[0] = raw
        for i in np.flatnonzero(free):
            moved = values.copy()
            moved[i] += steps[i]
            table[i + 1] = (self.misfit(moved, rate) - raw) / steps[i]
        white = noise.whiten(table)
        spreads = np.array([unknown.std for unknown in self.model.unknowns])
        known = np.diag(1.0 / spreads)
        rows = np.hstack([white[1:], known * free])
        return np.concatenate([white[0], values / spreads]), rows, raw

    def first(self) -> tuple[float, float]:
        """First position and speed of the load, by a line through the first samples."""
        size = max(8, round(_MOVED * self.position.size))
        slope, value = np.polyfit(self.interval * np.arange(size), self.position[:size], 1)
        return float(value), float(slope)


def descend(problem: Problem, start: Array, noise: Autoregression, free: Array, steps: int, rate: float = 0.0) -> Fit:
    """Levenberg-Marquardt from a start; only `free` (u,) unknowns move."""
    limits = problem.limits()
    values, damping = np.clip(start, -limits, limits), 1e-3
    residual, rows, raw = problem.rows(values, noise, free, rate)
    cost, count = float(residual @ residual), 1
    for _ in range(steps):
        size = np.linalg.norm(rows, axis=1)
        use = np.flatnonzero(free & (size > 0.0))
        scaled = rows[use] / size[use, None]
        matrix, downhill = scaled @ scaled.T, scaled @ residual
        better = False
        while damping < 1e6 and not better:
            step = np.zeros(values.size)
            step[use] = -np.linalg.solve(matrix + damping * np.eye(use.size), downhill) / size[use]
            ahead = np.clip(values + step, -limits, limits)
            ahead[HALF] = abs(ahead[HALF])
            move = (ahead - values) @ rows
            if -float(move @ (2.0 * residual + move)) <= _GAIN * cost / residual.size:
                return Fit(values, residual, rows, cost, raw, count)
            white = noise.whiten(problem.misfit(ahead, rate)[None])[0]
            prior = ahead / np.array([unknown.std for unknown in problem.model.unknowns])
            after, count = float(white @ white + prior @ prior), count + 1
            better = after < cost
            damping = max(1e-9, 0.1 * damping) if better else 10.0 * damping
        if not better:
            break
        values = ahead
        residual, rows, raw = problem.rows(values, noise, free, rate)
        cost = float(residual @ residual)
    return Fit(values, residual, rows, cost, raw, count)


def _delayed(drive: Array, samples: float) -> Array:
    """A signal (N,) that is late by a number of samples, by cubics through four neighbours; its ends last."""
    if samples == 0.0:
        return drive
    at = np.arange(drive.size) - samples
    whole = np.floor(at).astype(int)
    t = at - whole
    a, b, c, d = (drive[np.clip(whole + shift, 0, drive.size - 1)] for shift in (-1, 0, 1, 2))
    return np.asarray(b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a))))


def noise_of(raw: Array, floor: float) -> Autoregression:
    """Noise in a residual (m,), no quieter than white noise of a standard deviation `floor`."""
    dither = np.random.default_rng(0).normal(0.0, max(floor, 1e-300), raw.size)
    return burg((raw + dither)[None], min(_ORDER, raw.size // 10))


@dataclass(frozen=True, eq=False)
class Search:
    """The best fit of a window, and the other minima in its noise.

    Attributes
    ----------
    problem : Problem
    noise : Autoregression
    best : Fit
    others : tuple of Fit
    free : (u,) array of bool
    """

    problem: Problem
    noise: Autoregression
    best: Fit
    others: tuple[Fit, ...]
    free: Array


def starts(problem: Problem, gap: float) -> list[Array]:
    """Unknowns (u,) of a grid of gaps and offsets, the best ones of different gaps first.

    Parameters
    ----------
    problem : Problem
    gap : float
        Half gap at the load that is expected; 0: none.
    """
    lead, reach, first = problem.lead, problem.range, problem.first()
    middle = -0.5 * float(lead.max() + lead.min())
    halves = [share * reach for share in _HALVES] + ([gap] if gap > 0.0 else [])
    best = []
    for half in halves:
        tried = [problem.model.start(half, middle + place * reach, first) for place in _PLACES]
        costs = [_plain(problem, values, problem.model.speed) for values in tried]
        best.append((min(costs), tried[int(np.argmin(costs))]))
    return [values for _, values in sorted(best, key=lambda pair: pair[0])]


def _plain(problem: Problem, values: Array, rate: float = 0.0) -> float:
    raw = problem.misfit(values, rate)
    return float(raw @ raw)


def _distinct(fits: list[Fit]) -> list[Fit]:
    """Fits in different gaps, the best of each."""
    chosen: list[Fit] = []
    for fit in fits:
        if all(abs(fit.values[HALF] - one.values[HALF]) > _SAME * one.values[HALF] for one in chosen):
            chosen.append(fit)
    return chosen


def search(problem: Problem, gap: float) -> Search:
    """Fit a window: `gap` as in `starts`."""
    free, speed = np.ones(len(problem.model.unknowns), dtype=bool), problem.model.speed
    tried = starts(problem, gap)[:_FIRST]
    rough = math.sqrt(_plain(problem, tried[0], speed) / problem.position.size)
    noise = Autoregression.white(max(0.3 * rough, 1e-9 * problem.range))
    fits = [descend(problem, values, noise, free, 10, speed) for values in tried]
    for slower in _SLOWER:
        fits = _distinct(sorted(fits, key=lambda fit: fit.cost))[:_SECOND]
        noise = noise_of(fits[0].raw, max(_FLOOR * fits[0].values[HALF], 1e-9 * problem.range))
        fits = [descend(problem, fit.values, noise, free, 8, slower * speed) for fit in fits]
    fits.sort(key=lambda fit: fit.cost)
    for _ in range(_PASSES):
        best = fits[0]
        noise = noise_of(best.raw, max(_FLOOR * best.values[HALF], 1e-9 * problem.range))
        rate = _SLOWEST * speed
        fits = [descend(problem, fit.values, noise, free, 10, rate) for fit in _distinct(fits)[:_SECOND]]
        fits.sort(key=lambda fit: fit.cost)
    again = _from_anew(problem, noise, free, gap)
    if again[0].cost < fits[0].cost:
        # The noise was learnt from what a worse minimum had left.
        noise = noise_of(again[0].raw, max(_FLOOR * again[0].values[HALF], 1e-9 * problem.range))
        again = [descend(problem, fit.values, noise, free, 10, _SLOWEST * speed) for fit in _distinct(again)[:_SECOND]]
        fits = [descend(problem, fit.values, noise, free, 10, _SLOWEST * speed) for fit in fits]
    fits = _distinct(sorted([*fits, *again], key=lambda fit: fit.cost))
    return Search(problem, noise, fits[0], tuple(fits[1:]), free)


def _from_anew(problem: Problem, noise: Autoregression, free: Array, gap: float) -> list[Fit]:
    """Minima from the grid of starts in the noise that was learnt, the best first.

    Minima that were followed from white noise on can have led the model's numbers astray: these begin at its own.
    """
    rate = _SLOWEST * problem.model.speed
    tried = starts(problem, gap)
    for steps, kept in _AGAIN:
        fits = [descend(problem, values, noise, free, steps, rate) for values in tried]
        fits = _distinct(sorted(fits, key=lambda fit: fit.cost))[:kept]
        tried = [fit.values for fit in fits]
    return fits


def one_flank(found: Search) -> tuple[Fit, float]:
    """The best fit of a window in which the motor touches one flank only, and the way off it (m or rad at the load).

    The gap is so wide that the other flank is out of reach, and fixed.
    """
    problem, free = found.problem, found.free.copy()
    free[HALF] = False
    wide, lead, rate = _WIDE * problem.range, problem.lead, _SLOWEST * problem.model.speed
    middle = -0.5 * float(lead.max() + lead.min())
    best = []
    for side in (-1.0, 1.0):
        tried = []
        for place in _PLACES:
            values = found.best.values.copy()
            values[HALF], values[OFFSET] = wide, middle + place * problem.range + side * wide
            tried.append(values)
        costs = [_plain(problem, values, rate) for values in tried]
        start = tried[int(np.argmin(costs))]
        best.append((descend(problem, start, found.noise, free, _SINGLE_STEPS, rate), side))
    fit, side = min(best, key=lambda pair: pair[0].cost)
    motion = problem.motion(fit.values, rate)
    driven = math.exp(fit.values[RATIO]) * problem.drive + fit.values[OFFSET]
    off = math.exp(fit.values[RATIO]) * wide - side * (driven - motion.driven)
    return fit, max(0.0, float(off.max()))
