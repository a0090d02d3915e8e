"""Profiles of the sum of squares over the gap."""

from __future__ import annotations

import numpy as np

from servotwin.plant.signals import Array


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
