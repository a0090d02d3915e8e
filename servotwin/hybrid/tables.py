"""The numbers that the kernel needs for one automaton and one search step, in flat arrays.

Three scales, each a table: a *coarse* block of 128 steps checked every 8, a *fine* block of 8 steps checked every
step, and a single step as a Taylor polynomial. Between two checks a guard is the cubic with its values and slopes; its
Bernstein coefficients are the values and the values plus or minus a third of the slopes, so "no coefficient above zero"
means "the cubic does not leave the mode", and one product decides a whole block.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton, shared_flows

NODES_COARSE = 16
NODES_FINE = 8
PARTS = 8
PIECES = 5
# Doubles in two of the widest vectors.
VECTOR = 16
# |eigenvalue| * step <= 2 by the choice of the step: 2**24 / 24! = 3e-17, and (2 / 8)**13 / 13! = 2e-18. Fewer parts
# with more terms, for an event costs less than one more power: most tables are those of runs with few events.
TERMS = 24
PART_POWERS = 4  # of the flow, from which the 12 terms of a part of a step are made
SPECTRAL_STEP = 2.0
# A motion that lasts into the coarse search must turn slowly enough for a cubic over 8 steps: of 100 random pairs of
# undamped oscillators none lost an event at 0.2, 16 at 0.5 and 70 at 1.
LASTING_STEP = 0.25
# A slow law on a machine with a fast drive has a thousand steps a sample; with more than this something is not meant.
MOST_STEPS = 1e5


class Tables(NamedTuple):
    """Flat tables; `M` modes, `n` states, `G` guards per mode (padded with rows of 0), `F` different flows."""

    states: int
    guards: int
    guard_count: NDArray[np.int64]  # (M,) guards of each mode
    target: NDArray[np.int64]  # (M, G)
    has_reset: NDArray[np.bool_]  # (M, G)
    flow_of: NDArray[np.int64]  # (M,) which of the F flows
    reset: Array  # M * G * n * n, transposed: reset - I
    coarse: Array  # M * n * padded(G * 34): values, then thirds of the slopes, at 17 nodes 8 steps apart
    fine: Array  # M * n * padded(G * 18): the same at 9 nodes one step apart
    taylor: Array  # M * G * n * TERMS
    jump_coarse: Array  # F * 16 * n * n, transposed: exp(A 8 (j + 1) step) - I
    jump_fine: Array  # F * 8 * n * n, transposed
    jump_part: Array  # F * 8 * n * n, transposed: exp(A j step / 8) - I
    flow_part: Array  # F * n * (4 * n): powers 1 to 4 of A step / 8, transposed side by side
    single: Array  # M * n * (n + G * 4): the first of jump_fine beside Bernstein rows over one step
    rows: Array  # M * G * n
    sizes: Array  # M * G * TERMS * n: sum over the orders of abs(taylor), those of each derivative's own series
    changes: Array  # M * G * n: the same without order 0, with a margin for rounding
    bernstein: Array  # TERMS * 16: Taylor coefficients on [0, 1] to Bernstein rows over 5 intervals


class Numbers(NamedTuple):
    """Numbers in which automata of one structure differ, flat: what their tables are made of."""

    flows: Array  # M * n * n
    rows: Array  # M * G * n: guards
    resets: Array  # M * G * n * n


class Powers(NamedTuple):
    """``exp(A t) - I`` (the base) and ``exp(A j t) - I`` for the present j, row-major and flat: values and remainders,
    with working memory; each ``(n * n,)``. Only the rows that `moving` lists are not zero."""

    moving: NDArray[np.int64]  # (n,)
    movers: NDArray[np.int64]  # (1,) how many
    base: Array
    base_low: Array
    power: Array
    power_low: Array
    term: Array
    change: Array


def new_powers(states: int) -> Powers:
    """Working memory for matrices of so many states."""
    whole = np.zeros((2, max(states, 1)), dtype=np.int64)
    return Powers(whole[0], whole[1, :1], *np.zeros((6, states * states)))


class Workspace(NamedTuple):
    """Working memory to fill tables."""

    powers: Powers
    slopes: Array  # G * n: thirds of the guards' slopes over a second
    slope: Array
    row: Array
    next_row: Array
    orders: Array
    filled: NDArray[np.int8]  # (F,): 1 where a flow's tables are filled


def new_workspace(tables: Tables) -> Workspace:
    """Working memory to fill `tables`."""
    n, flows = tables.states, int(tables.flow_of.max()) + 1
    slope, row, next_row = np.zeros((3, n))
    slopes, filled = np.zeros(tables.guards * n), np.zeros(flows, dtype=np.int8)
    return Workspace(new_powers(n), slopes, slope, row, next_row, np.zeros(TERMS * n), filled)


class Pending(NamedTuple):
    """Tables that a run fills itself, those of a mode when it is first entered: most runs enter few of the modes."""

    filled: NDArray[np.int8]  # (M,)
    automaton: NDArray[np.int64]  # (1,) that the tables are of
    flows: Array  # (A, M * n * n)
    rows: Array  # (A, M * G * n)
    resets: Array  # (A, M * G * n * n), or (1, ...): those of all
    step: Array  # (A,) of the search, s
    reach: NDArray[np.int64]  # (A,) steps that are taken at once: with fewer than a fine block has, no blocks
    workspace: Workspace


def nothing_pending(tables: Tables) -> Pending:
    """For tables that are filled as a whole."""
    none = np.empty((0, 0))
    return Pending(
        np.ones(len(tables.guard_count), dtype=np.int8),
        np.zeros(1, dtype=np.int64),
        *(none,) * 3,
        np.empty(0),
        np.empty(0, dtype=np.int64),
        new_workspace(tables),
    )


def search_step(automaton: Automaton, sample_step: float) -> tuple[float, int]:
    """The largest ``sample_step / k`` on which no eigenvalue turns by more than two radians, and none whose motion
    lasts by more than a quarter, and k."""
    divisor = int(divisors(automaton.fastest, automaton.fastest_lasting, sample_step))
    return sample_step / divisor, divisor


def divisors(fastest: ArrayLike, fastest_lasting: ArrayLike, sample_step: ArrayLike) -> NDArray[np.int64]:
    """The number k of search steps a sample, of each automaton.

    Raises
    ------
    InvalidInput
        A motion that is so much faster than the samples that a run would never end.
    """
    turns = np.maximum(np.divide(fastest, SPECTRAL_STEP), np.divide(fastest_lasting, LASTING_STEP)) * np.asarray(
        sample_step
    )
    if np.max(turns, initial=0.0) > MOST_STEPS:
        shortest = 1.0 / np.max(fastest)
        raise InvalidInput(
            f"the fastest motion of the machine has a time constant of {shortest:.3g} s, too short for samples every "
            f"{np.max(sample_step):.3g} s (at most {MOST_STEPS:.0e} steps each): write 0 for an inductance or a lag "
            "that follows at once, and check the units of inertias, masses, stiffness and damping"
        )
    return np.maximum(1, np.ceil(turns - 0.05)).astype(np.int64)


def empty_tables(automaton: Automaton, flow_of: NDArray[np.int64] | None = None) -> Tables:
    """Tables with the structure of `automaton` and room for its numbers; `flow_of` when automata of that structure do
    not share its equal flows."""
    n, modes = len(automaton.names), automaton.modes
    guards, count = max(1, *(len(mode.guards) for mode in modes)), len(modes)
    flow_of = shared_flows(automaton.flows) if flow_of is None else flow_of
    flows = int(flow_of.max()) + 1
    target = np.zeros((count, guards), dtype=np.int64)
    has_reset = np.zeros((count, guards), dtype=bool)
    for m, mode in enumerate(modes):
        for g, guard in enumerate(mode.guards):
            target[m, g], has_reset[m, g] = guard.target, guard.reset is not None
    sizes = {
        "reset": count * guards * n * n,
        "coarse": count * n * padded(2 * guards * (NODES_COARSE + 1)),
        "fine": count * n * padded(2 * guards * (NODES_FINE + 1)),
        "taylor": count * guards * n * TERMS,
        "jump_coarse": flows * NODES_COARSE * n * n,
        "jump_fine": flows * NODES_FINE * n * n,
        "jump_part": flows * PARTS * n * n,
        "flow_part": flows * PART_POWERS * n * n,
        "single": count * n * (n + 4 * guards),
        "rows": count * guards * n,
        "sizes": count * guards * TERMS * n,
        "changes": count * guards * n,
    }
    return Tables(
        states=n,
        guards=guards,
        guard_count=np.array([len(mode.guards) for mode in modes]),
        target=target,
        has_reset=has_reset,
        flow_of=flow_of,
        bernstein=aligned(_bernstein_of_taylor().ravel()),
        **{name: zeros(size) for name, size in sizes.items()},
    )


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


def zeros(count: int) -> Array:
    """The same, of zeros; the system provides those pages that are used."""
    room = np.zeros(count + 8)
    start = -(room.ctypes.data // 8) % 8
    return room[start : start + count]


def room_for(counts: Sequence[int]) -> int:
    """Numbers that arrays of so many need in one piece of memory."""
    return sum(map(padded, counts))


def cut(room: Array, counts: Sequence[int]) -> list[Array]:
    """Arrays in a piece of memory of `zeros`, each from a cache line on."""
    ends = np.cumsum([0, *map(padded, counts)]).tolist()
    return [room[first : first + count] for first, count in zip(ends, counts, strict=False)]


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
