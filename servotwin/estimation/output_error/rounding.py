"""What samples and the encoders' rounding do to a fit: samples that show the same count have the same error."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.search import LEFT_COUNTS, rms
from servotwin.plant.signals import Array

_EVENLY = 1.0 / math.sqrt(12.0)  # standard deviation of a place anywhere in an interval, of its length
_NOTHING, _ALIKE = 1e-10, 1e-6  # of the best shown direction: none; share of an unknown in directions of which none is


def on_samples(found: Search, weights: Array) -> Array:
    """(k, m) weights of the residual that weights of the whitened one (k, m) stand for."""
    # The whitening filter, transposed.
    filtered = [np.convolve(row[::-1], found.noise.predictors[-1])[: row.size][::-1] for row in weights]
    return np.asarray(np.array(filtered) / found.noise.spread[-1])


def per_count(found: Search, weights: Array) -> Array:
    """(k, r) sums of weights of the whitened residual (k, m), back on the samples, over those of each count."""
    position, data = found.problem.position, weights.shape[1]
    margin = (position.size - data) // 2
    begins = np.flatnonzero(np.diff(position[margin : margin + data])) + 1
    return np.asarray(np.add.reduceat(on_samples(found, weights), np.concatenate([[0], begins]), axis=1))


def influence(found: Search, keep: NDArray[np.intp], which: int = HALF) -> tuple[float, float, float]:
    """Change of an unknown that some of the residuals ask for, linearised, its std, and that of rounding.

    Samples that show the same count have the same error: noise averages out over them, rounding does not. The second
    and third are inf where these residuals do not show it.
    """
    fit, data = found.best, found.best.raw.size
    weights, std = _weights(found, keep, which)
    if math.isinf(std):
        return 0.0, math.inf, math.inf
    white, seen = np.zeros(data), keep < data
    white[keep[seen]] = weights[seen]
    rounding = found.problem.count * _EVENLY * float(np.linalg.norm(per_count(found, white[None])))
    return float(weights @ fit.residual[keep]), std, rounding


def moved_by(found: Search, change: Array, which: int = HALF) -> float:
    """Change of an unknown, linearised, where the model's position were another by a change (m,) in m or rad; 0 where
    nothing shows it."""
    weights, std = _weights(found, np.arange(found.best.residual.size), which)
    return 0.0 if math.isinf(std) else float(weights[: change.size] @ found.noise.whiten(change[None])[0])


def _weights(found: Search, keep: NDArray[np.intp], which: int) -> tuple[Array, float]:
    """(k,) weights with which some of the residuals (k,) move an unknown, and its std; zeros and inf where they do not
    show it."""
    fit, places = found.best, np.flatnonzero(found.free)
    at, rows = int(np.flatnonzero(places == which)[0]), fit.rows[np.ix_(places, keep)]
    size = np.linalg.norm(rows, axis=1)
    size[size == 0.0] = 1.0
    scaled = rows / size[:, None]
    values, vectors = np.linalg.eigh(scaled @ scaled.T)
    shown = values > _NOTHING * values[-1]
    # Of two unknowns that move these residuals alike neither is shown.
    if float(np.sum(vectors[at, ~shown] ** 2)) > _ALIKE:
        return np.zeros(keep.size), math.inf
    inverse = (vectors[at, shown] / values[shown]) @ vectors[:, shown].T
    return -(inverse @ scaled) / size[at], math.sqrt(inverse[at] * fit.variance()) / size[at]


def rounded(found: Search, which: int = HALF) -> float:
    """Standard deviation of an unknown that the rounding of the encoders makes."""
    rounding = influence(found, np.arange(found.best.residual.size), which)[2]
    return rounding if math.isfinite(rounding) else 0.0


def all_rounding(found: Search) -> bool:
    """True where rounding may be all that the best fit leaves."""
    return rms(found.best.raw) <= LEFT_COUNTS * found.problem.count
