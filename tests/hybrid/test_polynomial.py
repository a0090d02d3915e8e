"""The first time a polynomial becomes positive, on polynomials whose roots are known."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as P

from servotwin.hybrid.compiled import compiled
from servotwin.hybrid.polynomial import DEPTH, bracketed_root, first_positive, value_and_slope
from servotwin.hybrid.tables import PIECES

TERMS = 24


@compiled
def _first(c, low, high):
    return first_positive(c, low, high, np.zeros(DEPTH + 2), np.zeros(DEPTH + 2))


@compiled
def _root(c, low, high):
    at_low, _ = value_and_slope(c, low)
    at_high, _ = value_and_slope(c, high)
    return bracketed_root(c, low, high, at_low, at_high)


def padded(c: np.ndarray) -> np.ndarray:
    return np.concatenate([np.asarray(c, dtype=float), np.zeros(TERMS - len(c))])


def first(c: np.ndarray, low: float = 0.0, high: float = 1.0) -> float:
    return _first(padded(c), low, high)


def with_roots(*roots: float, sign: float = 1.0) -> np.ndarray:
    return sign * P.polyfromroots(roots)


def test_value_and_slope() -> None:
    c = padded(np.array([1.0, -2.0, 0.5, 3.0]))
    value, slope = value_and_slope(c, 0.7)
    assert value == pytest.approx(P.polyval(0.7, c), rel=1e-15)
    assert slope == pytest.approx(P.polyval(0.7, P.polyder(c)), rel=1e-15)


@pytest.mark.parametrize("root", [1e-12, 1e-3, 0.3, 0.999, 1.0 - 1e-12])
def test_simple_root(root: float) -> None:
    assert first(with_roots(root, -0.5, 3.0, sign=-1.0)) == pytest.approx(root, rel=1e-12)


def test_no_root() -> None:
    assert first(with_roots(1.5)) == np.inf
    assert first(np.array([-1.0])) == np.inf
    assert first(np.array([0.0])) == np.inf
    assert first(np.array([-1e-300, 0.0, -1.0])) == np.inf


def test_first_of_several() -> None:
    c = with_roots(0.2, 0.4, 0.9)
    assert first(c) == pytest.approx(0.2, rel=1e-14)
    assert first(c, 0.45) == pytest.approx(0.9, rel=1e-13)
    assert first(c, 0.45, 0.8) == np.inf


def test_short_hump_is_found() -> None:
    for width in (1e-2, 1e-4, 1e-6):
        for middle in (0.1234, 0.5, 0.97):
            c = with_roots(middle - width, middle + width, sign=-1.0)
            assert first(c) == pytest.approx(middle - width, abs=1e-15 / width), (width, middle)


def test_double_root_from_below() -> None:
    """Touching is no crossing; below it there is nothing, above it two roots."""
    touch = with_roots(0.37, 0.37, sign=-1.0)
    found = first(touch)
    assert found == np.inf or abs(found - 0.37) < 3e-8
    assert first(touch - np.array([1e-14, 0.0, 0.0])) == np.inf
    above = first(touch + np.array([1e-10, 0.0, 0.0]))
    assert above == pytest.approx(0.37 - 1e-5, abs=1e-11)


def test_positive_from_a_zero_start() -> None:
    """A root at the beginning: rising from it is found there, touching from above too."""
    assert first(np.array([0.0, 1.0])) < 1e-12
    assert first(np.array([0.0, 0.0, 1.0])) < 1e-6
    assert first(np.array([0.0, -1.0, 2.0])) == pytest.approx(0.5, rel=1e-14)


def test_root_at_the_end() -> None:
    assert first(np.array([-1.0, 1.0])) == np.inf, "p <= 0 on the whole interval"
    just = np.nextafter(1.0, 0.0)
    assert first(np.array([-just, 1.0])) == pytest.approx(1.0, rel=1e-15)
    assert first(np.array([-0.25, 0.5]), 0.0, 0.5) == np.inf


def test_clustered_roots() -> None:
    """Up, down and up again within 1e-4; and a triple root, known to the cube root of rounding only."""
    c = with_roots(0.5, 0.5 + 5e-5, 0.5 + 1e-4)
    assert first(c) == pytest.approx(0.5, abs=1e-7)
    assert first(with_roots(0.5, 0.5, 0.5)) == pytest.approx(0.5, abs=2e-5)


def test_bracketed_root_of_steep_and_flat_polynomials() -> None:
    for power in (1, 3, 9, 21):
        c = np.zeros(TERMS)
        c[0], c[power] = -(0.3**power), 1.0
        assert _root(c, 0.0, 1.0) == pytest.approx(0.3, rel=1e-14), power


def first_in_pieces(c: np.ndarray, low: float) -> float:
    """As the kernel looks: fifth by fifth, so that each is nearly a cubic."""
    ends = np.concatenate([[low], np.arange(1, PIECES + 1) / PIECES])
    ends = ends[ends >= low]
    found = (first(c, a, b) for a, b in itertools.pairwise(ends))
    return next((root for root in found if root < np.inf), np.inf)


@given(
    st.lists(st.floats(0.02, 0.98), min_size=1, max_size=6),
    st.lists(st.floats(1.1, 3.0), max_size=4),
    st.floats(1e-3, 1e3),
)
def test_random_roots(inside: list[float], outside: list[float], scale: float) -> None:
    """The sign changes of a product of linear factors, one after the other, as well as the coefficients know them."""
    roots = np.sort(inside)
    if np.any(np.diff(roots) < 1e-2):
        roots = roots[:1]
    c = with_roots(*roots, *outside)
    c *= -scale * np.sign(c[0])
    low = 0.0
    for k, root in enumerate(roots):
        known_to = 30 * np.finfo(float).eps * P.polyval(root, np.abs(c)) / abs(P.polyval(root, P.polyder(c)))
        assert first_in_pieces(c * (-1.0) ** k, low) == pytest.approx(root, abs=known_to + 1e-12)
        low = root + 1e-3


def test_two_roots_between_two_nodes() -> None:
    """The cubic through the ends of [0.4, 0.6] stays below zero here, the quartic does not."""
    assert first(with_roots(0.25, 0.5, 0.5625, 0.625), 0.26, 1.0) == pytest.approx(0.5, rel=1e-12)
    assert first(with_roots(0.5, 0.5625, 0.625), 0.4, 0.6) == pytest.approx(0.5, rel=1e-12)
