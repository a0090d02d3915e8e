"""Least squares and autoregressions of short lists of floats."""

from collections.abc import Mapping, Sequence
from math import inf, log, sqrt
from operator import mul
from typing import NamedTuple

Row = Sequence[float]
_DEPENDENT = 1e-7  # of a column's length: what is left of it below this is rounding


def dot(one: Row, other: Row) -> float:
    """Inner product."""
    return sum(map(mul, one, other))


class Fit(NamedTuple):
    """A target fitted by columns.

    Attributes
    ----------
    coefficients : list of float
        One for each column; 0 for one that depends on those before it.
    residual : list of float
        What is left of the target.
    places : list of int
        The columns that depend on none before them.
    triangle : list of lists
        Column k of the upper triangle that turns orthonormal columns into those.
    """

    coefficients: list[float]
    residual: list[float]
    places: list[int]
    triangle: list[list[float]]

    def deviation(self, weights: Mapping[int, float]) -> float:
        """Of a weighted sum of coefficients, for white noise of variance 1; inf: nothing shows one of them."""
        if any(weight != 0.0 and place not in self.places for place, weight in weights.items()):
            return inf
        found: list[float] = []
        for place, column in zip(self.places, self.triangle, strict=True):
            found.append((weights.get(place, 0.0) - dot(column[:-1], found)) / column[-1])
        return sqrt(dot(found, found))


def fit(columns: Sequence[Row], target: Row) -> Fit:
    """Least squares by Gram and Schmidt's method, each column twice."""
    basis: list[list[float]] = []
    places: list[int] = []
    triangle: list[list[float]] = []
    for place, column in enumerate(columns):
        shares, left = _off(basis, column)
        length = sqrt(dot(left, left))
        if length > _DEPENDENT * sqrt(dot(column, column)):
            basis.append([x / length for x in left])
            triangle.append([*shares, length])
            places.append(place)
    shares, left = _off(basis, target)
    found = dict(zip(places, _back(triangle, shares), strict=True))
    return Fit([found.get(place, 0.0) for place in range(len(columns))], left, places, triangle)


def _off(basis: Sequence[Row], row: Row) -> tuple[list[float], list[float]]:
    """A row's shares along orthonormal ones, and what is left of it."""
    shares, left = [0.0] * len(basis), list(row)
    for _ in range(2):
        for k, known in enumerate(basis):
            share = dot(known, left)
            shares[k] += share
            left = [x - share * y for x, y in zip(left, known, strict=True)]
    return shares, left


def _back(triangle: Sequence[Row], shares: Row) -> list[float]:
    """Back substitution; column k of the triangle is `triangle[k]`."""
    rest, found = list(shares), [0.0] * len(triangle)
    for k in range(len(triangle) - 1, -1, -1):
        found[k] = rest[k] / triangle[k][k]
        for i in range(k):
            rest[i] -= found[k] * triangle[k][i]
    return found


class Predictors(NamedTuple):
    """Prediction error filters of every order, 1 first, and the powers that they leave."""

    filters: list[list[float]]
    powers: list[float]

    def whitened(self, row: Row) -> list[float]:
        """(m,) errors of prediction over their standard deviations; sample i is predicted from those before it."""
        order = len(self.filters) - 1
        roots = [sqrt(power) for power in self.powers]
        ramp = [dot(self.filters[i], row[i::-1]) / roots[i] for i in range(min(order, len(row)))]
        whole = [0.0] * max(0, len(row) - order)
        for lag, tap in enumerate(self.filters[order]):
            part = row[order - lag : len(row) - lag]
            whole = [x + tap * y for x, y in zip(whole, part, strict=True)]
        return ramp + [x / roots[order] for x in whole]


def burg(series: Row, most: int, floor: float) -> Predictors:
    """The autoregression of a series by Burg's method, its order (at most `most`) by the corrected Akaike criterion.

    Powers are at least `floor`.
    """
    forward, backward = list(series), list(series)
    filters, powers = [[1.0]], [dot(series, series) / len(series)]
    for _ in range(most):
        ahead, behind = forward[1:], backward[:-1]
        square = dot(ahead, ahead) + dot(behind, behind)
        turn = -2.0 * dot(ahead, behind) / square if square > 0.0 else 0.0
        forward = [f + turn * b for f, b in zip(ahead, behind, strict=True)]
        backward = [b + turn * f for f, b in zip(ahead, behind, strict=True)]
        last = [*filters[-1], 0.0]
        filters.append([x + turn * y for x, y in zip(last, reversed(last), strict=True)])
        powers.append(powers[-1] * (1.0 - turn * turn))
    best = min(range(most + 1), key=lambda order: _criterion(powers[order], order, len(series)))
    return Predictors(filters[: best + 1], [max(power, floor) for power in powers[: best + 1]])


def _criterion(power: float, order: int, size: int) -> float:
    count = order + 1
    return size * log(max(power, 1e-300)) + 2.0 * count * size / max(1, size - count - 1)
