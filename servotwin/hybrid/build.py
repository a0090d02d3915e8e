"""Fill the tables of an automaton: compiled, without the GIL, into memory that the next automaton reuses."""

from __future__ import annotations

import numpy as np

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.compiled import bare, subroutine
from servotwin.hybrid.exponential import next_power, rebase, start_powers
from servotwin.hybrid.flow import listed_product, product
from servotwin.hybrid.tables import (
    NODES_COARSE,
    NODES_FINE,
    PART_POWERS,
    PARTS,
    TERMS,
    VECTOR,
    Numbers,
    Pending,
    Powers,
    Tables,
    Workspace,
    empty_tables,
    new_workspace,
)


def numbers_of(automaton: Automaton, guards: int) -> Numbers:
    """Numbers of one automaton, padded to `guards` guards in every mode."""
    n, modes = len(automaton.names), automaton.modes
    rows, resets = np.zeros((len(modes), guards, n)), np.zeros((len(modes), guards, n, n))
    for m, mode in enumerate(modes):
        for g, guard in enumerate(mode.guards):
            rows[m, g] = guard.row
            if guard.reset is not None:
                resets[m, g] = guard.reset
    return Numbers(automaton.flows.ravel(), rows.ravel(), resets.ravel())


def build_tables(automaton: Automaton, step: float) -> Tables:
    """All tables of `automaton` for one search step in seconds."""
    tables = empty_tables(automaton)
    fill_tables(tables, numbers_of(automaton, tables.guards), step, NODES_FINE, new_workspace(tables))
    return tables


@subroutine
def _fill_guards(t: Tables, numbers: Numbers, mode: int, w: Workspace) -> None:
    """Rows, slopes and resets."""
    n = t.states
    for g in range(t.guard_count[mode]):
        at = (mode * t.guards + g) * n
        for i in range(n):
            t.rows[at + i] = numbers.rows[at + i]
        slopes = w.slopes[g * n : (g + 1) * n]
        product(numbers.flows, mode * n * n, n, n, t.rows[at : at + n], slopes)
        for i in range(n):
            slopes[i] /= 3.0
            for j in range(n):
                t.reset[(at + j) * n + i] = numbers.resets[(at + i) * n + j] - (i == j)


@subroutine
def _fill_single(t: Tables, mode: int) -> None:
    """One step: the flow's first power, and every guard's Bernstein rows from its values and slopes at both ends."""
    n, stride = t.states, t.states + 4 * t.guards
    count, nodes = t.guard_count[mode], NODES_FINE + 1
    width = (2 * t.guards * nodes + VECTOR - 1) // VECTOR * VECTOR
    for j in range(n):
        at, source = (mode * n + j) * stride, (mode * n + j) * width
        for r in range(n):
            t.single[at + r] = t.jump_fine[(t.flow_of[mode] * NODES_FINE * n + j) * n + r]
        for g in range(count):
            value, third = source + g * nodes, source + (count + g) * nodes
            to = at + n + 4 * g
            t.single[to] = t.fine[value]
            t.single[to + 1] = t.fine[value] + t.fine[third]
            t.single[to + 2] = t.fine[value + 1] - t.fine[third + 1]
            t.single[to + 3] = t.fine[value + 1]


@subroutine
def _fill_orders(t: Tables, numbers: Numbers, flow: int, mode: int, step: float, w: Workspace) -> None:
    """The powers ``(A s)**k`` of a part's flow, k = 1 .. PART_POWERS, transposed side by side."""
    n, stride, p = t.states, t.states * PART_POWERS, w.powers
    base, source = flow * n * stride, mode * n * n
    moving = p.moving[: p.movers[0]]
    part = w.row[: moving.size]
    for at in range(base, base + n * stride):
        t.flow_part[at] = 0.0
    for i in moving:
        for j in range(n):
            w.powers.term[j] = numbers.flows[source + i * n + j] * (step / PARTS)
        for k in range(PART_POWERS):
            for j in range(n):
                t.flow_part[base + j * stride + k * n + i] = w.powers.term[j]
            for j in range(moving.size):
                part[j] = w.powers.term[moving[j]]
            listed_product(numbers.flows, source, n, n, moving, part, w.next_row)
            for j in range(n):
                w.powers.term[j] = w.next_row[j] * (step / PARTS)


@subroutine
def _store(p: Powers, n: int, table: Array, base: int) -> None:
    """The present power, transposed."""
    for i in range(n):
        for j in range(n):
            table[base + j * n + i] = p.power[i * n + j]


@subroutine
def _fill_guard(
    t: Tables, table: Array, nodes: int, mode: int, g: int, node: int, spacing: float, w: Workspace
) -> None:
    """A guard's value and a third of its slope at a node, and at node 0 together with node 1."""
    n, count = t.states, t.guard_count[mode]
    stride = (2 * t.guards * (nodes + 1) + VECTOR - 1) // VECTOR * VECTOR
    at = mode * n * stride + g * (nodes + 1) + node
    thirds = count * (nodes + 1)
    guard = (mode * t.guards + g) * n
    row = t.rows[guard : guard + n]
    for j in range(n):
        w.slope[j] = w.slopes[g * n + j] * spacing
    product(w.powers.power, 0, n, n, row, w.row)
    product(w.powers.power, 0, n, n, w.slope, w.next_row)
    for j in range(n):
        table[at + j * stride] = row[j] + w.row[j]
        table[at + j * stride + thirds] = w.slope[j] + w.next_row[j]
        if node == 1:
            table[at + j * stride - 1] = row[j]
            table[at + j * stride + thirds - 1] = w.slope[j]


@subroutine
def _fill_jumps(t: Tables, jumps: Array, nodes: int, count: int, flow: int, p: Powers) -> None:
    """The first jumps of one scale: the present power becomes its base, and its powers follow."""
    n = t.states
    rebase(n, p)
    for j in range(count):
        if j > 0:
            next_power(n, p)
        _store(p, n, jumps, (flow * nodes + j) * n * n)


@subroutine
def _fill_flow(t: Tables, numbers: Numbers, mode: int, step: float, reach: int, w: Workspace) -> None:
    """Everything that advances by the flow of a mode."""
    n, flow, p = t.states, t.flow_of[mode], w.powers
    start_powers(numbers.flows, mode * n * n, n, step / PARTS, p)
    _fill_orders(t, numbers, flow, mode, step, w)
    base = flow * PARTS * n * n
    for i in range(n * n):
        t.jump_part[base + i] = 0.0
    for j in range(1, PARTS):
        _store(p, n, t.jump_part, base + j * n * n)
        next_power(n, p)
    _fill_jumps(t, t.jump_fine, int(NODES_FINE), min(reach, NODES_FINE), flow, p)
    if reach >= NODES_FINE:
        _fill_jumps(t, t.jump_coarse, int(NODES_COARSE), int(NODES_COARSE), flow, p)


@subroutine
def _fill_nodes(
    t: Tables, table: Array, jumps: Array, nodes: int, count: int, mode: int, spacing: float, w: Workspace
) -> None:
    """The guards of a mode at the first nodes of one scale."""
    n, p = t.states, w.powers
    for j in range(count):
        base = (t.flow_of[mode] * nodes + j) * n * n
        for i in range(n):
            for k in range(n):
                p.power[i * n + k] = jumps[base + k * n + i]
        for g in range(t.guard_count[mode]):
            _fill_guard(t, table, nodes, mode, g, j + 1, spacing, w)


@subroutine
def _fill_series(t: Tables, numbers: Numbers, mode: int, g: int, step: float, w: Workspace) -> None:
    """A guard's Taylor series over a step, the sizes of all the terms that enter it and each of its derivatives."""
    n = t.states
    at = mode * t.guards + g
    for i in range(n):
        w.row[i] = t.rows[at * n + i]
        t.changes[at * n + i] = 1e-12 * abs(w.row[i])
    for k in range(TERMS):
        for i in range(n):
            t.taylor[(at * n + i) * TERMS + k] = w.row[i]
            w.orders[k * n + i] = abs(w.row[i])
            if k > 0:
                t.changes[at * n + i] += abs(w.row[i])
        product(numbers.flows, mode * n * n, n, n, w.row, w.next_row)
        for i in range(n):
            w.row[i] = w.next_row[i] * (step / (k + 1))
    for k in range(TERMS):
        # Partial sums from the end: the k-th time they are the terms of the k-th derivative's own series.
        for j in range(TERMS - 2, k - 1, -1):
            for i in range(n):
                w.orders[j * n + i] += w.orders[(j + 1) * n + i]
        for i in range(n):
            t.sizes[(at * TERMS + k) * n + i] = w.orders[k * n + i]


@bare
def _fill_mode(t: Tables, numbers: Numbers, mode: int, step: float, reach: int, w: Workspace) -> None:
    """Tables of one mode, and of its flow where no mode before it had the same."""
    if w.filled[t.flow_of[mode]] == 0:
        _fill_flow(t, numbers, mode, step, reach, w)
        w.filled[t.flow_of[mode]] = 1
    _fill_guards(t, numbers, mode, w)
    blocks = reach >= NODES_FINE
    # Literals would have the functions compiled once for each.
    _fill_nodes(t, t.fine, t.jump_fine, int(NODES_FINE), NODES_FINE if blocks else 1, mode, step, w)
    if blocks:
        _fill_nodes(t, t.coarse, t.jump_coarse, int(NODES_COARSE), int(NODES_COARSE), mode, step * NODES_FINE, w)
    for g in range(t.guard_count[mode]):
        _fill_series(t, numbers, mode, g, step, w)
    _fill_single(t, mode)


def fill_tables(t: Tables, numbers: Numbers, step: float, reach: int, w: Workspace) -> None:
    """Tables of the automaton with these numbers; `t` has its structure. `reach` are the steps that a loop takes at
    once: what only blocks need is left out where it is fewer than a fine block has."""
    w.filled[:] = 0
    # Not compiled: all that a compiled function calls is compiled once more with it.
    for mode in range(len(t.guard_count)):
        _fill_mode(t, numbers, mode, step, reach, w)


@subroutine
def begin_tables(pending: Pending, automaton: int) -> None:
    """Leave the tables of all modes to the run of one automaton."""
    pending.automaton[0] = automaton
    for mode in range(len(pending.filled)):
        pending.filled[mode] = 0
    for flow in range(len(pending.workspace.filled)):
        pending.workspace.filled[flow] = 0


@subroutine
def fill_entered(t: Tables, mode: int, pending: Pending) -> None:
    """Tables of a mode that is entered for the first time."""
    a = pending.automaton[0]
    numbers = Numbers(pending.flows[a], pending.rows[a], pending.resets[min(a, len(pending.resets) - 1)])
    _fill_mode(t, numbers, mode, pending.step[a], pending.reach[a], pending.workspace)
    pending.filled[mode] = 1
