"""Least squares of load = ratio x play(motor) + offset + nuisances, as normal matrices of every stroke for every gap.

For a given gap the model is linear in everything else. Sums of products by stroke are all that fits, comparisons on
unseen strokes and bootstrap need: the samples are passed once for each gap of a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import Strokes, play_and_side
from servotwin.plant.signals import Array

ROWS = 150_000  # samples that count, evenly chosen; the play itself passes all of them
SPAN = 5  # samples on either side of a difference quotient
LOAD, RATIO, OFFSET, LAG, WIND_UP, INERTIA = "load", "ratio", "offset", "lag", "wind-up", "acceleration"


class Regression(NamedTuple):
    """A recording prepared for the regression.

    Attributes
    ----------
    recording : EncoderRecording
    strokes : Strokes
    rows : (k,) int array
        Samples that count.
    bounds : (m,) int array
        First row of each stroke.
    cycles : (c,) array
        Cyclic errors: periods of the motor, in its unit.
    lag : float
        s, by which the load follows the motor; the lag's column is the rest, to first order.
    """

    recording: EncoderRecording
    strokes: Strokes
    rows: Any
    bounds: Any
    cycles: Array
    lag: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        command = (WIND_UP,) if self.recording.command is not None else ()
        cyclic = tuple(f"cycle {i}{part}" for i in range(len(self.cycles)) for part in ("s", "c"))
        return (LOAD, RATIO, OFFSET, LAG, INERTIA, *command, *cyclic)


def regression(
    recording: EncoderRecording,
    strokes: Strokes,
    first: int,
    known: Any = None,
    cycles: Sequence[float] = (),
    lag: float = 0.0,
) -> Regression:
    """Choose the rows from sample `first` on; those that `known` (n,) says not to count do not."""
    begin = max(first, int(strokes.begin[0]))
    rows = np.unique(np.linspace(begin, recording.motor.size - 1, min(ROWS, recording.motor.size - begin)).astype(int))
    rows = rows if known is None or not known[rows].any() else rows[known[rows]]
    bounds = np.searchsorted(rows, np.maximum(strokes.begin, begin))
    kept = np.diff(bounds, append=rows.size) > 0
    strokes = Strokes(strokes.begin[kept], strokes.side[kept])
    return Regression(recording, strokes, rows, bounds[kept], np.asarray(cycles, dtype=float), lag)


def columns(design: Regression, gap: float) -> tuple[Array, Array]:
    """Columns of the regression, (p, k), and the side of the flank that was touched last, (k,).

    Positions count from the first sample: a zero that is many turns away would take the digits of the motion.
    """
    recording = design.recording
    side = np.zeros(recording.motor.size, dtype=np.int8)
    output, time = play_and_side(recording.motor, gap, side), recording.time
    if design.lag:
        output = np.interp(time - design.lag, time, output)
    rate = _rate(time, output)
    output = output - recording.motor[0]
    rows = [recording.load - recording.load[0], output, np.ones_like(output), -rate, _rate(time, rate)]
    if recording.command is not None:
        rows.append(recording.command)
    chosen = [row[design.rows] for row in rows]
    angle = output[design.rows]
    for period in design.cycles:
        phase = 2.0 * np.pi / period * angle
        chosen += [np.sin(phase), np.cos(phase)]
    return np.array(chosen), side[design.rows]


def _rate(time: Array, values: Array) -> Array:
    """Difference quotient over a few samples on either side."""
    result = np.zeros_like(values)
    if values.size > 2 * SPAN:
        result[SPAN:-SPAN] = (values[2 * SPAN :] - values[: -2 * SPAN]) / (time[2 * SPAN :] - time[: -2 * SPAN])
    return result


def products(design: Regression, gap: float, *weights: Array) -> tuple[Array, ...]:
    """Sums of products of the columns, (m strokes, p, p): of all rows alike, and under each of the weights (k,)."""
    values, _ = columns(design, gap)
    return tuple(_by_stroke(each, values, design.bounds) for each in (values, *(values * weight for weight in weights)))


def _by_stroke(weighted: Array, values: Array, bounds: Any) -> Array:
    ends = [*bounds[1:], values.shape[1]]
    return np.array([weighted[:, a:b] @ values[:, a:b].T for a, b in zip(bounds, ends, strict=True)])


class Solution(NamedTuple):
    """Least-squares fits, one for each leading index.

    Attributes
    ----------
    squares : array
        Sum of squares left.
    coefficients : (..., q) array
    """

    squares: Array
    coefficients: Array


def solved(matrices: Array, used: Sequence[int]) -> Solution:
    """Regress column 0 on the columns `used`, from (..., p, p) sums of products."""
    used = list(used)
    inner = matrices[..., used, :][..., :, used]
    right = matrices[..., used, :][..., :, 0]
    scale = np.sqrt(np.maximum(np.diagonal(inner, axis1=-2, axis2=-1), np.finfo(float).tiny))
    normal = inner / (scale[..., :, None] * scale[..., None, :]) + 1e-12 * np.eye(len(used))
    found = np.linalg.solve(normal, (right / scale)[..., None])[..., 0] / scale
    squares = matrices[..., 0, 0] - np.einsum("...i,...i", found, right)
    return Solution(np.maximum(squares, 0.0), found)


def squares_of(matrices: Array, used: Sequence[int], coefficients: Array) -> Array:
    """Sum of squares that given coefficients leave."""
    used = list(used)
    inner = matrices[..., used, :][..., :, used]
    right = matrices[..., used, :][..., :, 0]
    quadratic = np.einsum("...i,...ij,...j", coefficients, inner, coefficients)
    return matrices[..., 0, 0] - 2.0 * np.einsum("...i,...i", coefficients, right) + quadratic


def least_gap(grid: Array, squares: Array) -> Array:
    """Gap of the least sum of squares along the last axis, by a parabola through the three lowest points."""
    if grid.size < 3:
        return grid[np.argmin(squares, axis=-1)]
    place = np.clip(np.argmin(squares, axis=-1), 1, grid.size - 2)
    before, at, after = (np.take_along_axis(squares, (place + k)[..., None], axis=-1)[..., 0] for k in (-1, 0, 1))
    low, mid, high = grid[place - 1], grid[place], grid[place + 1]
    first, second = (at - before) / (mid - low), (after - at) / (high - mid)
    curvature = (second - first) / (high - low)
    bent = curvature > 0.0
    found = 0.5 * (low + mid) - 0.5 * first / np.where(bent, curvature, 1.0)
    # At an edge of the grid, or on a flat profile, the lowest point itself.
    return np.where(bent, np.clip(found, low, high), grid[np.argmin(squares, axis=-1)])


def interpolated(grid: Array, values: Array, gap: float) -> float:
    """Values of a profile at a gap, by the parabola through the three nearest points."""
    if grid.size < 3:
        return float(values[0])
    place = int(np.clip(np.argmin(np.abs(grid - gap)), 1, grid.size - 2))
    x, y = grid[place - 1 : place + 2], values[place - 1 : place + 2]
    weights = [np.prod([(gap - x[j]) / (x[i] - x[j]) for j in range(3) if j != i]) for i in range(3)]
    return float(np.dot(weights, y))
