"""The numbers that the kernel needs for one automaton and one search step, in flat arrays.

Three scales, each a table: a *coarse* block of 128 steps looked at every 8, a *fine* block of 8 steps looked at every
step, and a single step as a Taylor polynomial. Between two looks a guard is the cubic with its values and slopes; its
Bernstein coefficients are the values and the values plus or minus a third of the slopes, so "no coefficient above zero"
means "the cubic does not leave the mode", and one product settles a whole block.
"""

from __future__ import annotations

from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.exponential import Long, expm1, powers, taylor_rows

NODES_COARSE = 16
NODES_FINE = 8
PARTS = 32
PIECES = 5
# Doubles in two of the widest vectors.
VECTOR = 16
# |eigenvalue| * step <= 2 by the choice of the step: 2**24 / 24! = 3e-17, and (2 / 32)**9 / 9! = 4e-17.
TERMS = 24
PART_TERMS = 8
SPECTRAL_STEP = 2.0
# What has not died out when the coarse search begins must turn slowly enough for a cubic over 8 steps: of 100 random
# pairs of undamped oscillators none lost an event at 0.2, 16 at 0.5 and 70 at 1.
LASTING_STEP = 0.25


class Tables(NamedTuple):
    """Flat tables; `M` modes, `n` states, `G` guards per mode (padded with rows of -0)."""

    states: int
    guards: int
    guard_count: NDArray[np.int64]  # (M,) guards of each mode
    target: NDArray[np.int64]  # (M, G)
    has_reset: NDArray[np.bool_]  # (M, G)
    reset: Array  # M * G * n * n, transposed: reset - I
    coarse: Array  # M * n * padded(G * 34): values, then thirds of the slopes, at 17 nodes 8 steps apart
    fine: Array  # M * n * padded(G * 18): the same at 9 nodes one step apart
    taylor: Array  # M * G * n * TERMS
    jump_coarse: Array  # M * 16 * n * n, transposed: exp(A 8 (j + 1) step) - I
    jump_fine: Array  # M * 8 * n * n, transposed
    jump_part: Array  # M * 32 * n * n, transposed: exp(A j step / 32) - I
    flow_part: Array  # M * n * (8 * n): the Taylor series of exp(A s step / 32) x in s, without its first term
    single: Array  # M * n * (n + G * 4): the first of jump_fine beside Bernstein rows over one step
    rows: Array  # M * G * n
    sizes: Array  # M * G * TERMS * n: sum over the orders of abs(taylor), those of each derivative's own series
    changes: Array  # M * G * n: the same without order 0, with a margin for rounding
    bernstein: Array  # TERMS * 16: Taylor coefficients on [0, 1] to Bernstein rows over 5 intervals


def search_step(automaton: Automaton, sample_step: float) -> tuple[float, int]:
    """The largest ``sample_step / k`` on which no eigenvalue turns by more than two radians, and none whose motion
    lasts by more than a quarter, and k."""
    turns = max(automaton.fastest / SPECTRAL_STEP, automaton.fastest_lasting / LASTING_STEP) * sample_step
    divisor = max(1, int(np.ceil(turns - 0.05)))
    return sample_step / divisor, divisor


def build_tables(automaton: Automaton, step: float) -> Tables:
    """All tables of `automaton` for one search step in seconds."""
    n, modes = len(automaton.names), automaton.modes
    guards = max(1, *(len(mode.guards) for mode in modes))
    count = np.array([len(mode.guards) for mode in modes])
    target = np.zeros((len(modes), guards), dtype=np.int64)
    has_reset = np.zeros((len(modes), guards), dtype=bool)
    reset = np.zeros((len(modes), guards, n, n))
    rows = np.zeros((len(modes), guards, n))
    for m, mode in enumerate(modes):
        for g, guard in enumerate(mode.guards):
            target[m, g], rows[m, g] = guard.target, guard.row
            if guard.reset is not None:
                has_reset[m, g], reset[m, g] = True, (np.asarray(guard.reset) - np.eye(n)).T
    parts = zip(
        *(_mode_tables(automaton.flows[m], rows[m], step, len(modes[m].guards)) for m in range(len(modes))), strict=True
    )
    flat = [aligned(np.array(part, dtype=float).ravel()) for part in parts]
    coarse, fine, taylor, jump_coarse, jump_fine, jump_part, flow_part, single = flat
    orders = np.abs(taylor.reshape(len(modes), guards, n, TERMS))
    return Tables(
        states=n,
        guards=guards,
        guard_count=count,
        target=target,
        has_reset=has_reset,
        reset=reset.ravel(),
        coarse=coarse,
        fine=fine,
        taylor=taylor,
        jump_coarse=jump_coarse,
        jump_fine=jump_fine,
        jump_part=jump_part,
        flow_part=flow_part,
        single=single,
        rows=rows.ravel(),
        sizes=np.einsum("kj,mgij->mgki", _binomials(), orders).ravel(),
        changes=(orders[..., 1:].sum(axis=3) + 1e-12 * orders[..., 0]).ravel(),
        bernstein=_bernstein_of_taylor().ravel(),
    )


def _binomials() -> Array:
    """``[k, j]`` is "j over k": the terms of the k-th derivative's own series in those of the function's."""
    return np.array([[float(comb(j, k)) for j in range(TERMS)] for k in range(TERMS)])


def _mode_tables(flow: Array, rows: Array, step: float, count: int) -> tuple[Long, ...]:
    unit = expm1(flow, step)
    fine = powers(unit, NODES_FINE)
    coarse = powers(fine[-1], NODES_COARSE)
    part = np.concatenate([np.zeros((1, *flow.shape), np.longdouble), powers(expm1(flow, step / PARTS), PARTS - 1)])
    taylor = np.array([taylor_rows(row, flow, step, TERMS).T for row in rows])
    slopes = rows @ flow
    return (
        _node_rows(rows, slopes * (NODES_FINE * step), coarse, count),
        _node_rows(rows, slopes * step, fine, count),
        taylor,
        coarse.transpose(0, 2, 1),
        fine.transpose(0, 2, 1),
        part.transpose(0, 2, 1),
        taylor_rows(np.eye(len(flow)), flow, step / PARTS, PART_TERMS + 1)[1:].reshape(-1, len(flow)).T,
        np.hstack([unit.T, _step_rows(rows, slopes * step, unit)]),
    )


def _node_rows(rows: Array, slopes: Array, deviations: Long, count: int) -> Long:
    """Values, then thirds of the slopes, of the first `count` guards at nodes 0, 1, ... (`deviations`), padded to the
    columns that all the guards need."""
    node = np.concatenate([np.zeros((1, *deviations[0].shape), np.longdouble), deviations])
    parts = [part[:count, None] + np.einsum("gi,kij->gkj", part[:count], node) for part in (rows, slopes / 3)]
    table = np.concatenate(parts).reshape(-1, rows.shape[1]).T
    result = np.zeros((len(table), padded(2 * len(rows) * len(node))), dtype=np.longdouble)
    result[:, : table.shape[1]] = table
    return result


def _step_rows(rows: Array, slopes: Array, unit: Long) -> Long:
    """Bernstein rows of every guard over one step, ``(n, G * 4)``."""
    later, later_slopes = rows + rows @ unit, slopes + slopes @ unit
    bernstein = [rows, rows + slopes / 3, later - later_slopes / 3, later]
    return np.stack(bernstein, axis=1).reshape(-1, rows.shape[1]).T


def padded(rows: int) -> int:
    """Columns of a table of `rows` rows: products over whole vectors of the machine have no remainder."""
    return -(-rows // VECTOR) * VECTOR


def aligned(flat: Array) -> Array:
    """A copy that starts on a cache line, so that no vector spans two."""
    room = np.empty(len(flat) + 8)
    start = -(room.ctypes.data // 8) % 8
    result = room[start : start + len(flat)]
    result[:] = flat
    return result


def _bernstein_of_taylor() -> Array:
    order = np.arange(TERMS)
    result = np.empty((TERMS, 3 * PIECES + 1))
    for node in range(PIECES + 1):
        place = node / PIECES
        value = place**order
        third = np.concatenate([[0.0], order[1:] * place ** (order[1:] - 1)]) / (3 * PIECES)
        result[:, 3 * node] = value
        if node < PIECES:
            result[:, 3 * node + 1] = value + third
        if node:
            result[:, 3 * node - 1] = value - third
    return result
