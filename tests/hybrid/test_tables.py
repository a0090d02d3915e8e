"""The kernel's tables against their definitions, and filled again for other numbers."""

import numpy as np
import pytest
from exploration import explored
from test_exponential import exact, off

from servotwin.hybrid.automaton import Automaton
from servotwin.hybrid.build import begin_tables, build_tables, fill_entered, fill_tables, new_workspace, numbers_of
from servotwin.hybrid.compiled import bare
from servotwin.hybrid.flow import advance_fraction, new_scratch
from servotwin.hybrid.tables import (
    NODES_COARSE,
    NODES_FINE,
    PART_POWERS,
    PARTS,
    TERMS,
    Tables,
    empty_tables,
    nothing_pending,
    search_step,
)
from servotwin.plant.automaton import Shape, continuous_loop
from servotwin.plant.servo import Servo

SHAPES = [Shape(), Shape(dead_zone=False), Shape(gap=3), Shape(dead_zone=False, bias=True, feedforward=True)]


def loop(shape: Shape, **changes: float) -> tuple[Automaton, float]:
    """The paper's loop and its search step for 100 samples a second."""
    servo = Servo.preset("paper").replace(**changes)
    automaton = continuous_loop(servo, servo.controller, shape).automaton
    return automaton, search_step(automaton, 0.01)[0]


@pytest.mark.slow
@pytest.mark.parametrize("shape", explored(SHAPES, 0, 3))
def test_jumps_are_exponentials(shape: Shape) -> None:
    automaton, step = loop(shape)
    tables, n = build_tables(automaton, step), len(automaton.names)
    parts = tables.jump_part.reshape(-1, PARTS, n, n)
    fine = tables.jump_fine.reshape(-1, NODES_FINE, n, n)
    assert not parts[:, 0].any()
    for flow, which in zip(automaton.flows, tables.flow_of, strict=True):
        for j in (1, 2, 5, PARTS - 1):
            assert off(parts[which, j].T, exact(flow, j * step / PARTS, 30)) < 2e-15, j
        assert off(fine[which, 0].T, exact(flow, step)) < 1e-14


def test_every_scale_begins_where_the_finer_one_ends() -> None:
    automaton, step = loop(Shape())
    tables, n = build_tables(automaton, step), len(automaton.names)
    fine = tables.jump_fine.reshape(-1, NODES_FINE, n, n)
    coarse = tables.jump_coarse.reshape(-1, NODES_COARSE, n, n)
    assert np.array_equal(fine[:, -1], coarse[:, 0])
    one = np.eye(n) + coarse[:, 0].transpose(0, 2, 1)
    for j in range(NODES_COARSE):
        expected = np.linalg.matrix_power(one, j + 1) - np.eye(n)
        assert np.abs(coarse[:, j].transpose(0, 2, 1) - expected).max() < 1e-12 * np.abs(expected).max()


def test_equal_flows_are_kept_once() -> None:
    """With a constant gap both flanks flow alike, and both sides of the dead zone always do."""
    kept = [tuple(build_tables(*loop(shape)).flow_of.tolist()) for shape in SHAPES[:3]]
    assert kept[1] == (0, 1, 0)
    assert [len(set(flows)) for flows in kept] == [4, 2, 6]


@pytest.mark.slow
def test_series_of_a_guard() -> None:
    """Its values along the flow by the polynomial, and sizes and changes that bound it."""
    automaton, step = loop(Shape())
    tables, n = build_tables(automaton, step), len(automaton.names)
    taylor = tables.taylor.reshape(len(automaton.modes), tables.guards, n, TERMS)
    sizes = tables.sizes.reshape(len(automaton.modes), tables.guards, TERMS, n)
    for m, mode in enumerate(automaton.modes):
        for g, guard in enumerate(mode.guards):
            row = np.asarray(guard.row, dtype=float)
            end = row + row @ exact(automaton.flows[m], step)
            assert np.abs(taylor[m, g].sum(axis=1) - end).max() <= 1e-13 * np.abs(taylor[m, g]).sum(axis=1).max()
            derivative = np.abs(taylor[m, g]) * np.arange(TERMS)
            assert np.allclose(sizes[m, g, 0], np.abs(taylor[m, g]).sum(axis=1), rtol=1e-13, atol=0.0)
            assert np.allclose(sizes[m, g, 1], derivative.sum(axis=1), rtol=1e-13, atol=0.0)


def test_powers_of_a_part() -> None:
    automaton, step = loop(Shape())
    tables, n = build_tables(automaton, step), len(automaton.names)
    powers = tables.flow_part.reshape(-1, n, PART_POWERS, n)
    for flow, which in zip(automaton.flows, tables.flow_of, strict=True):
        one = flow * (step / PARTS)
        for k in range(PART_POWERS):
            expected = np.linalg.matrix_power(one, k + 1)
            size = np.linalg.matrix_power(np.abs(one), k + 1)
            assert np.all(np.abs(powers[which, :, k].T - expected) <= 1e-14 * size)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_a_part_of_a_step_is_an_exponential(shape: Shape) -> None:
    """To the rounding of what enters it, however much cancels."""
    (automaton, step), rng = loop(shape), np.random.default_rng(3)
    tables, n = build_tables(automaton, step), len(automaton.names)
    scratch, worst = new_scratch(tables), 0.0
    for mode, flow in enumerate(automaton.flows):
        for fraction in (1e-9, 0.03, 0.1249, 0.125, 0.37, 0.9999, 1.0):
            x = rng.normal(size=n)
            moved = x.copy()
            advance_fraction(tables, mode, moved, fraction, scratch)
            jump = exact(flow, fraction * step)
            worst = max(worst, float(np.max(np.abs(moved - x - jump @ x) / (np.abs(x) + np.abs(jump) @ np.abs(x)))))
    assert worst < 2e-15


@pytest.mark.parametrize("shape", SHAPES)
def test_filled_again_they_are_as_new(shape: Shape) -> None:
    """Nothing of what the tables held before stays."""
    (first, step), (second, other) = loop(shape), loop(shape, k=1.1e4, c=20.0, Ki=3e3)
    fresh, reused = build_tables(second, other), build_tables(first, step)
    assert not same(fresh, reused)
    fill_tables(reused, numbers_of(second, reused.guards), other, NODES_FINE, new_workspace(reused))
    assert same(fresh, reused)


@bare
def fill_one(tables, mode, pending):
    """Call a subroutine, which Python could call only where it is compiled for that, every time."""
    fill_entered(tables, mode, pending)


@pytest.mark.parametrize("shape", SHAPES)
def test_filled_mode_by_mode_in_any_order_they_are_the_same(shape: Shape) -> None:
    automaton, step = loop(shape)
    whole, tables = build_tables(automaton, step), empty_tables(automaton)
    numbers, order = numbers_of(automaton, tables.guards), range(len(automaton.modes) - 1, -1, -1)
    pending = nothing_pending(tables)._replace(
        flows=numbers.flows[None],
        rows=numbers.rows[None],
        resets=numbers.resets[None],
        step=np.array([step]),
        reach=np.array([NODES_FINE]),
    )
    begin_tables(pending, 0)
    for mode in order:
        assert pending.filled[mode] == 0
        fill_one(tables, mode, pending)
    assert pending.filled.all()
    assert same(whole, tables)


def same(one: Tables, other: Tables) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("reach", [1, 3])
def test_tables_for_few_steps_hold_what_these_steps_need(reach: int) -> None:
    automaton, step = loop(Shape())
    whole, few = build_tables(automaton, step), empty_tables(automaton)
    fill_tables(few, numbers_of(automaton, few.guards), step, reach, new_workspace(few))
    for name in ("reset", "taylor", "jump_part", "flow_part", "single", "rows", "sizes", "changes"):
        assert np.array_equal(getattr(few, name), getattr(whole, name)), name
    n = len(automaton.names)
    jumps, expected = (each.jump_fine.reshape(-1, NODES_FINE, n, n) for each in (few, whole))
    assert np.array_equal(jumps[:, :reach], expected[:, :reach])
    assert not few.coarse.any()
