"""Noise as an autoregression, estimated by Burg's method, and the filter that makes it white.

Burg's method needs no window at the ends of the data; the autocorrelation method (Yule-Walker) has one, whose leakage
hides the deep low-frequency notch of high-passed noise, exactly where the gap shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.hybrid.compiled import bare, compiled, inlined, summed
from servotwin.plant.signals import Array


@dataclass(frozen=True, eq=False)
class Autoregression:
    """Predictors of every order up to p, for a series of which less than p samples are known too.

    Attributes
    ----------
    predictors : (p + 1, p + 1) array
        Row k: prediction error filter of order k, 1 first.
    spread : (p + 1,) array
        Standard deviation of the prediction error of order k.
    """

    predictors: Array
    spread: Array

    @classmethod
    def white(cls, std: float) -> Autoregression:
        """White noise of a standard deviation: a model without memory."""
        return cls(np.ones((1, 1)), np.array([std]))

    def at_least(self, spread: float) -> Autoregression:
        """Raise the standard deviation of the innovations to at least `spread`."""
        return Autoregression(self.predictors, np.maximum(self.spread, spread))

    @property
    def order(self) -> int:
        """Highest order, p."""
        return self.spread.size - 1

    @property
    def unpredicted(self) -> float:
        """Share of the variance that no earlier sample predicts; 1: white."""
        return float(self.spread[-1] / self.spread[0]) ** 2 if self.spread[0] > 0.0 else 1.0

    def whiten(self, columns: Array, more: int = 0) -> Array:
        """(k, n + more) rows (k, n) as errors of prediction over their standard deviation, from the first sample on.

        Sample i is predicted from all i before it, at most from p. Noise of the model comes out white, of variance 1.
        Behind the last sample are as many zeros as asked for.
        """
        out = np.zeros((len(columns), columns.shape[1] + more))
        whiten(columns, self.predictors, self.spread, out)
        return out

    def colour_back(self, weights: Array) -> Array:
        """(n,) weights of the white innovations in a weighted sum (n,) of the noise, whose variance is their square.

        The noise is the innovations through an all-pole filter; the weights go through it backwards in time.
        """
        out = np.empty(weights.size)
        filter_backwards(np.ascontiguousarray(weights), self.predictors[-1], float(self.spread[-1]), out)
        return out


def burg(series: Array, most: int) -> Autoregression:
    """The autoregression of equally likely series (s, n), its order chosen by the corrected Akaike criterion.

    The order is at most `most`, and chosen as if there were one series: the others add no information, they only state
    what is not known of it.
    """
    # One recursion gives the predictors and powers of all orders, so the choice of the order costs nothing more.
    predictors, power = recursion(series, most)
    best = int(np.argmin(_criteria(power, series.shape[1])))
    return Autoregression(predictors[: best + 1, : best + 1].copy(), np.sqrt(power[: best + 1]))


def with_noise_restored(residual: Array, columns: Array, root: Array, scale: float = 1.0) -> Array:
    """(1 + d, n) series for `burg` of the noise in a residual (n,), with what the fit may have taken put back.

    A fit takes noise away with every parameter, and most where the gap shows, so that the residual looks quieter there
    than the noise was. It is put back one standard deviation up and down along every direction of the parameters: 2 d
    equally likely series, whose products are those of the residual and of what is put back, without mixed ones.

    Parameters
    ----------
    left : (n,) array
        Residual of the fit.
    columns : (k, n) array
        Rows that were fitted.
    root : (d, k) array
        `LeastSquares.root` of the whitened fit.
    scale : float
        Standard deviation of the whitened noise.
    """
    return math.sqrt(1.0 + len(root)) * np.vstack([residual, scale * (root @ columns)])


def criterion(series: Array, most: int) -> float:
    """AICc of the autoregression that `burg` would choose for a series (n,)."""
    return float(_criteria(recursion(series[None], most)[1], series.size).min())


def _criteria(power: Array, size: int) -> Array:
    """AICc of Gaussian autoregressions of order 0, 1, ... with these powers; the power itself is one more parameter."""
    count = 1.0 + np.arange(power.size)
    # The bound keeps the logarithm finite for a residual that is exactly zero.
    return np.asarray(size * np.log(np.maximum(power, 1e-300)) + 2.0 * count * size / np.maximum(1, size - count - 1))


@summed
def correlation(ahead: Array, behind: Array) -> tuple[float, float]:
    """Sums of the products of forward and backward errors, and of their squares."""
    across = square = 0.0
    for i in range(ahead.size):
        across += ahead[i] * behind[i]
        square += ahead[i] * ahead[i] + behind[i] * behind[i]
    return across, square


@inlined
def reflect(ahead: Array, behind: Array, reflection: float) -> None:
    """Run one stage of the lattice, in place."""
    for i in range(ahead.size):
        one, two = ahead[i], behind[i]
        ahead[i] = one + reflection * two
        behind[i] = two + reflection * one


@compiled
def recursion(series: Array, most: int) -> tuple[Array, Array]:
    """Burg's recursion: prediction error filters (most + 1, most + 1) and powers (most + 1,) of all orders."""
    count, size = series.shape
    predictors, power = np.zeros((most + 1, most + 1)), np.zeros(most + 1)
    predictors[0, 0] = 1.0
    power[0] = np.sum(series * series) / (count * size)
    # A backward error is stored at the first sample of its series: beside the forward error of the same stage.
    forward, backward = series.copy(), series.copy()
    for order in range(1, most + 1):
        across = square = 0.0
        for k in range(count):
            one, two = correlation(forward[k, order:], backward[k, : size - order])
            across += one
            square += two
        # Over all series together; its size is at most 1, so that the predictor is stable.
        reflection = -2.0 * across / square if square > 0.0 else 0.0
        for k in range(count):
            reflect(forward[k, order:], backward[k, : size - order], reflection)
        for i in range(order + 1):
            last = predictors[order - 1, order - i] if i > 0 else 0.0
            predictors[order, i] = predictors[order - 1, i] + reflection * last
        power[order] = power[order - 1] * (1.0 - reflection * reflection)
    return predictors, power


@inlined
def add_four(one: float, two: float, three: float, four: float, late: Array, out: Array) -> None:
    """Add to `out` (n,) a signal, given from three samples before, weighted now, one, two and three samples later."""
    for i in range(out.size):
        out[i] += (one * late[i + 3] + two * late[i + 2]) + (three * late[i + 1] + four * late[i])


@bare
def whiten(columns: Array, predictors: Array, spread: Array, out: Array) -> None:
    """`Autoregression.whiten` into the first samples of `out`: those without p before them one by one, the others four
    coefficients at a time."""
    most, size = spread.size - 1, columns.shape[1]
    weights, fours = predictors[most], 4 * (most // 4)
    for k in range(len(columns)):
        column, white = columns[k], out[k]
        for i in range(min(most, size)):
            total = 0.0
            for j in range(i + 1):
                total += predictors[i, j] * column[i - j]
            white[i] = total / spread[i]
        left = white[most:size]
        for i in range(left.size):
            left[i] = column[i + most]
        for j in range(1, fours, 4):
            add_four(weights[j], weights[j + 1], weights[j + 2], weights[j + 3], column[most - j - 3 :], left)
        for j in range(fours + 1, most + 1):
            for i in range(left.size):
                left[i] += weights[j] * column[i + most - j]
        for i in range(left.size):
            left[i] /= spread[most]


@bare
def filter_backwards(weights: Array, poles: Array, gain: float, out: Array) -> None:
    """Filter (n,) weights backwards in time, from rest, with a gain over the polynomial `poles`, into `out`."""
    size, order = weights.size, poles.size - 1
    for i in range(size - 1, -1, -1):
        total = gain * weights[i]
        for j in range(1, min(order, size - 1 - i) + 1):
            total -= poles[j] * out[i + j]
        out[i] = total
