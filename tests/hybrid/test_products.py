"""Products of tables with states against numpy's, and the numbers of intervals that are read off them."""

import numpy as np
import pytest

from servotwin.hybrid.build import build_tables
from servotwin.hybrid.flow import clean_intervals, listed_product, tall_product
from servotwin.hybrid.lifted import FINE, lifted_counts, lifted_in
from servotwin.hybrid.lifted_blocks import clean_part
from servotwin.hybrid.tables import search_step
from servotwin.plant.automaton import Shape, continuous_loop
from servotwin.plant.servo import Servo


@pytest.mark.parametrize("columns", [0, 1, 3, 4, 7, 8, 12, 13, 16, 21])
def test_a_tall_product_is_the_matrix_times_the_state(columns: int) -> None:
    rng, rows, stride = np.random.default_rng(columns), 19, 23
    table, x, out = rng.normal(size=5 + 22 * stride), rng.normal(size=columns), np.full(rows, np.nan)
    tall_product(table, 5, stride, rows, x, out)
    assert np.allclose(out, x @ _columns(table, np.arange(columns), stride, rows), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("columns", [0, 1, 3, 4, 7, 8, 12, 13, 16, 21])
def test_a_listed_product_takes_the_columns_that_are_listed(columns: int) -> None:
    rng, rows, stride = np.random.default_rng(columns), 19, 23
    table, x, out = rng.normal(size=5 + 30 * stride), rng.normal(size=columns), np.full(rows, np.nan)
    which = np.sort(rng.permutation(29)[:columns])
    listed_product(table, 5, stride, rows, which, x, out)
    assert np.allclose(out, x @ _columns(table, which, stride, rows), rtol=0.0, atol=1e-14)


def test_a_number_of_intervals_is_an_integer_to_compiled_code() -> None:
    """As a float it makes one of the step that it is added to, and all that takes a step is compiled once more."""
    servo = Servo.preset("paper")
    automaton = continuous_loop(servo, servo.controller, Shape()).automaton
    tables = build_tables(automaton, search_step(automaton, 0.01)[0])
    found = [clean_intervals(tables, 0, np.zeros(tables.states), np.zeros(4 * tables.guards * 9), 9, 8)]
    lifted = lifted_in([np.zeros(size) for size in lifted_counts(4, 2, 1)], 4, 2)
    low, high, slack, squares = -np.ones(2), np.ones(2), np.zeros(2), np.zeros(2)
    out = np.zeros(2 * (3 * FINE + 1 + 4))
    found.append(clean_part(lifted, lifted.sizes, 0, 2, FINE, 8, low, high, slack, 0.0, squares, np.zeros(4), out))
    assert [(type(number), number) for number in found] == [(int, 8), (int, 8)]


def _columns(table: np.ndarray, which: np.ndarray, stride: int, rows: int) -> np.ndarray:
    """(columns, rows) of a flat table that begins at 5."""
    return table[5 + stride * which[:, None] + np.arange(rows)]
