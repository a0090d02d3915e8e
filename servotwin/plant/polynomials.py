"""Polynomials with ascending coefficients, and what they become on the imaginary axis."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce

import numpy as np
from numpy.polynomial import polynomial as poly

from servotwin.plant.signals import Array


def times(first: Array, second: Array) -> Array:
    """Product."""
    return np.asarray(poly.polymul(first, second), dtype=float)


def plus(first: Array, second: Array) -> Array:
    """Sum."""
    return np.asarray(poly.polyadd(first, second), dtype=float)


def minus(first: Array, second: Array) -> Array:
    """Difference."""
    return np.asarray(poly.polysub(first, second), dtype=float)


def product(factors: Iterable[Array]) -> Array:
    """Product of any number of polynomials."""
    return reduce(times, factors, np.array([1.0]))


def mirrored(p: Array) -> Array:
    """p(-s)."""
    return np.asarray(p * (-1.0) ** np.arange(p.size))


def on_axis(p: Array) -> tuple[Array, Array]:
    """(real, imaginary) with p(j w) = real(w^2) + j w imaginary(w^2)."""
    padded = np.append(p, np.zeros(p.size % 2))
    signs = (-1.0) ** np.arange(padded.size // 2)
    return padded[0::2] * signs, padded[1::2] * signs


def squared_modulus(p: Array) -> Array:
    """The polynomial in w^2 that is abs(p(j w))^2."""
    return on_axis(times(p, mirrored(p)))[0]


def positive_roots(p: Array) -> Array:
    """(K,) ascending real positive roots, those with a small imaginary part included: a start for polishing."""
    p = np.trim_zeros(p, "b")
    p = p[int(np.argmax(p != 0.0)) :] if p.size else p
    if p.size < 2:
        return np.zeros(0)
    size = np.abs(p[0] / p[-1]) ** (1.0 / (p.size - 1))
    scaled = p * size ** (np.arange(p.size) - (p.size - 1))
    roots = poly.polyroots(scaled / np.max(np.abs(scaled))) * size
    close = (roots.real > 0.0) & (np.abs(roots.imag) <= 1e-4 * np.abs(roots))
    return np.sort(roots[close].real)
