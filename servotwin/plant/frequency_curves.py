"""Margins and encirclements read off curves that are known at ascending frequencies, many curves at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.linear import Complex
from servotwin.plant.signals import Array

# Relative: frequencies that are no closer are different ones.
_DISTINCT = 1e-9
# Steps of 1 + L from one frequency to the next, relative to its size, up to which the curve between them is known.
_RESOLVED = 0.8
# Tangent of the angle between a curve at its lowest frequency and its asymptote, up to which nothing turns it below.
_ASYMPTOTIC = 0.5
# Logarithm of the largest gain margin that is told from an infinite one.
_LARGEST = 700.0
# The least value between two frequencies is searched for by zooming in.
_ZOOMS, _INSIDE = 2, np.linspace(0.0, 1.0, 17)


def squares(values: Complex) -> Array:
    """Squares of absolute values."""
    return np.asarray(values.real**2 + values.imag**2)


def encirclements(returned: Complex, integrators: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(P,) numbers of pairs of closed-loop poles beyond the boundary, and True where the frequencies resolve the curve.

    `returned` is 1 + L along the boundary, (P, F) at ascending frequencies; of a stable loop it turns by a quarter for
    each of the integrators.
    """
    steps = squares(np.diff(returned, axis=1))
    sizes = squares(returned)
    resolved = np.all(steps < _RESOLVED**2 * np.minimum(sizes[:, 1:], sizes[:, :-1]), axis=1)
    # A slow law, or one that acts against its direction at rest, still turns the curve below the lowest frequency.
    start = returned[:, 0] * 1j**integrators
    resolved &= np.abs(start.imag) < _ASYMPTOTIC * start.real
    upper, left = returned.imag >= 0.0, returned.real < 0.0
    # Steps are short beside the distance from zero: a crossing of the negative real axis has an end left of zero.
    across = (upper[:, 1:] != upper[:, :-1]) & (left[:, 1:] | left[:, :-1])
    turns = np.sum(np.where(across, np.where(upper[:, :-1], 1, -1), 0), axis=1)
    turned = np.angle(returned[:, -1]) - np.angle(returned[:, 0]) + 2.0 * np.pi * turns
    return np.rint(0.25 * integrators - turned / (2.0 * np.pi)).astype(np.int64), resolved


def least_values(omega: Array, values: Array, value: Callable[[Array], Array]) -> Array:
    """(P,) least values of a function of frequency: about the lowest of (P, F) samples the search is refined."""
    place = np.argmin(values, axis=1)[:, None]
    best, least = (np.take_along_axis(each, place, axis=1) for each in (omega, values))
    # Not simply the neighbours: equal frequencies may stand side by side.
    low = np.max(np.where(omega < best * (1.0 - _DISTINCT), omega, omega[:, :1]), axis=1, keepdims=True)
    high = np.min(np.where(omega > best * (1.0 + _DISTINCT), omega, omega[:, -1:]), axis=1, keepdims=True)
    least = least[:, 0]
    for _ in range(_ZOOMS):
        fine = low + (high - low) * _INSIDE
        found = value(fine)
        place = np.argmin(found, axis=1)[:, None]
        least = np.minimum(least, np.take_along_axis(found, place, axis=1)[:, 0])
        low, high = (np.take_along_axis(fine, np.clip(place + k, 0, fine.shape[1] - 1), axis=1) for k in (-1, 1))
    return np.asarray(least)


def distances(omega: Array, loop: Complex, value: Callable[[Array], Complex]) -> tuple[Array, Array, Array]:
    """(P,) least gain margins, phase margins (rad) and delay margins (s); the crossing of each is refined."""
    coarse = _crossings(omega, loop)
    least = []
    for kind, every in enumerate(coarse):
        place = np.argmin(every, axis=1)[:, None]
        low, high = (np.take_along_axis(omega, place + k, axis=1) for k in (0, 1))
        fine = low + (high - low) * _INSIDE
        refined = _crossings(fine, value(fine))[kind].min(axis=1)
        least.append(np.where(np.isfinite(refined), refined, every.min(axis=1)))
    return least[0], np.minimum(least[1], np.pi), least[2]


@np.errstate(all="ignore")
def _crossings(omega: Array, loop: Complex) -> Array:
    """(3, P, F - 1) gain margin, phase margin (rad) and delay margin (s) between each two frequencies; inf: no
    crossing."""
    size = np.log(np.abs(loop))
    # The angle of -L: pi plus the phase of L. Between two frequencies it turns by less than half a turn.
    before, turn = np.angle(-loop[:, :-1]), np.angle(loop[:, 1:] / loop[:, :-1])
    share = size[:, :-1] / (size[:, :-1] - size[:, 1:])
    crosses = (size[:, :-1] >= 0.0) != (size[:, 1:] >= 0.0)
    angle = before + share * turn
    phase = np.where(crosses, np.abs(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi), np.inf)
    late = np.where(crosses, np.mod(angle, 2.0 * np.pi) / (omega[:, :-1] + share * np.diff(omega, axis=1)), np.inf)
    # Where L crosses the negative real axis the angle of -L crosses zero without a jump.
    crosses = (np.abs(before) < 0.5 * np.pi) & ((before >= 0.0) != (before + turn >= 0.0))
    share = np.where(crosses, before / -turn, 0.0)
    distance = np.abs(size[:, :-1] + share * np.diff(size, axis=1))
    return np.array([np.where(crosses, np.exp(np.minimum(distance, _LARGEST)), np.inf), phase, late])
