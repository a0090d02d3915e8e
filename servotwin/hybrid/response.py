"""The plant over a block of ticks as one linear map: of its state at the start, and of the inputs held tick by tick.

As long as no guard fires, the position that a tick measures is the block's free response plus the pulse responses to
the inputs so far. What sets the inputs may do as it likes at every tick: noise, rounding and limits need no tables.

A guard is followed by its *lanes*: at every tick its Bernstein coefficients over every search step, as in `tables`.
They need not be looked at where the guard cannot reach zero within the block, whatever its inputs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.compiled import inlined
from servotwin.hybrid.flow import LINGERING, dot, dot_sizes, rounding, tall_product, wide_product
from servotwin.hybrid.tables import NODES_FINE, Tables, aligned, zeros

TICKS = 8
"""Ticks of a block."""


class BlockResponses(NamedTuple):
    """Flat tables of `M` modes, `n` states, `G` guards and at most `L` lanes a tick; inputs follow the states."""

    lanes: int
    lane_count: NDArray[np.int64]  # (M,) lanes of each mode
    position: Array  # M * n * 8: the position at this block's ticks, of the state with the input left out
    ahead: Array  # M * n * (8 + n): the same at the next block's ticks, and the change of the state in this one
    pulse: Array  # M * 32: the position -16 .. 15 ticks after an input's tick, zero up to one tick after it
    next: Array  # M: the position one tick after it
    watch: Array  # M * (n + 8) * (L * 8): lanes, tick after tick, as many as the mode has, of its columns
    input_change: Array  # M * 8 * n: change of the state in a block, of the inputs
    step: Array  # M * 8 * (n + 8) * n: change of the state after 1 .. 8 ticks
    columns: NDArray[np.int64]  # M * n: states on which lanes depend, then the others
    column_count: NDArray[np.int64]  # (M,) of the former and the inputs, a multiple of eight
    slow: NDArray[np.bool_]  # (M,) where guards hardly change in a block: a bound of their change is tried first
    reach: Array  # M * G * (n + 8): largest change of a guard in a block, of the sizes of state and inputs
    guard: NDArray[np.int64]  # (M, L): the guard of each lane, -1: none


class ResponseMemory(NamedTuple):
    """Working memory of one run."""

    position: Array  # 16: at the ticks of this block and of the next one
    start: Array  # n + 8: state at the start, the input left out, and the inputs
    seen: Array  # n + 8: states and inputs on which lanes depend
    watch: Array  # L * 8
    ahead: Array  # 8 + n
    change: Array  # n


class _Mode(NamedTuple):
    """One mode over the ticks of this block and the next one."""

    rows: tuple[Array, ...]  # of its guards, (n,) each
    powers: list[Array]  # 1 .. 15 of a tick's map without its input, less one
    pulses: list[Array]  # states that a pulse leaves after 1 .. 15 ticks
    lanes: Array  # rows (lanes, n) of the state after the tick
    owners: list[int]  # the guard of every lane
    input_index: int  # index of the input

    def seen(self, rows: Array, ticks: int = TICKS) -> Array:
        """(ticks, R, n + 8): rows of the state after the tick, of the state at the start and the block's inputs."""
        n = rows.shape[1]
        out = np.zeros((ticks, len(rows), n + TICKS))
        delayed = [rows[:, self.input_index], *(rows @ pulse for pulse in self.pulses)]
        for j in range(ticks):
            out[j, :, :n] = rows + (rows @ self.powers[j - 1] if j else 0.0)
            out[j, :, self.input_index] = 0.0
            for i in range(min(j + 1, TICKS)):
                out[j, :, n + i] = delayed[j - i]
        return out


def new_response_memory(r: BlockResponses, states: int) -> ResponseMemory:
    """Working memory for one run."""
    return ResponseMemory(
        position=zeros(2 * TICKS),
        start=zeros(states + TICKS),
        seen=zeros(states + TICKS),
        watch=zeros(r.lanes * TICKS),
        ahead=zeros(TICKS + states),
        change=zeros(states),
    )


def build_responses(
    automaton: Automaton, t: Tables, step: float, searches: int, input_index: int, position: int
) -> BlockResponses:
    """All responses to the input that is the state `input_index`, with so many search steps (s) a tick."""
    n, row = t.states, np.eye(t.states)[[position]]
    modes = [_mode(automaton, t, m, step, searches, input_index) for m in range(len(automaton.modes))]
    lanes = max([1] + [len(mode.owners) for mode in modes])
    positions = [mode.seen(row, 2 * TICKS)[:, 0, :n].T for mode in modes]
    pulses = [np.array([row[0] @ pulse for pulse in mode.pulses]) for mode in modes]
    watched = [_watched(mode, lanes) for mode in modes]
    changes = [_changes(mode, t.guards) for mode in modes]
    return BlockResponses(
        lanes=lanes,
        lane_count=np.array([len(mode.owners) for mode in modes]),
        position=_flat([each[:, :TICKS] for each in positions]),
        ahead=_flat(
            [
                np.hstack([each[:, TICKS:], mode.powers[TICKS - 1].T])
                for each, mode in zip(positions, modes, strict=True)
            ]
        ),
        pulse=_flat([np.concatenate([np.zeros(2 * TICKS + 2), each[1:]]) for each in pulses]),
        next=np.array([each[0] for each in pulses]),
        watch=_flat([each[0] for each in watched]),
        input_change=_flat([np.array(mode.pulses[TICKS - 1 :: -1]) for mode in modes]),
        step=_flat([_step(mode, ticks) for mode in modes for ticks in range(1, TICKS + 1)]),
        columns=np.concatenate([each[1] for each in watched]),
        column_count=np.array([each[2] for each in watched]),
        slow=np.array([each[1] for each in changes]),
        reach=_flat([each[0] for each in changes]),
        guard=np.array([mode.owners + [-1] * (lanes - len(mode.owners)) for mode in modes]),
    )


def output_responses(r: BlockResponses, row: Array, input_index: int) -> tuple[Array, Array]:
    """(M, 8, n) and (M, 8): an output at the ticks of a block, of the state at its start, and after an input's tick."""
    n = row.size
    step = r.step.reshape(-1, TICKS, n + TICKS, n)
    free = np.broadcast_to(row, (len(step), TICKS, n)).copy()
    free[:, 1:] += step[:, :-1, :n] @ row
    late = np.full((len(step), TICKS), row[input_index])
    late[:, 1:] = step[:, :-1, n] @ row
    return free, late


def _flat(parts: list[Array]) -> Array:
    return aligned(np.concatenate([np.ravel(part) for part in parts]))


def _mode(automaton: Automaton, t: Tables, m: int, step: float, searches: int, input_index: int) -> _Mode:
    """A mode with its lanes; the flow of a search step is that of the tables."""
    n = t.states
    at = t.flow_of[m] * NODES_FINE * n * n
    search, flow = t.jump_fine[at : at + n * n].reshape(n, n).T, automaton.flows[m]
    rows, lanes, owners = [], [np.zeros((0, n))], []
    for g, guard in enumerate(automaton.modes[m].guards):
        value = np.asarray(guard.row, dtype=float)
        third = value @ flow * (step / 3.0)
        rows.append(value)
        # An input that enters a guard moves it at the tick; any other guard begins where it ended.
        own = [value] if value[input_index] != 0.0 else []
        for _ in range(searches):
            second = value + third
            value, third = value + value @ search, third + third @ search
            own += [second, value - third, value]
        lanes.append(np.array(own))
        owners += [g] * len(own)
    return _Mode(tuple(rows), *_powers(search, searches, input_index), np.vstack(lanes), owners, input_index)


def _powers(search: Array, searches: int, input_index: int) -> tuple[list[Array], list[Array]]:
    """Powers of a tick's map without its input, less one, and the states that a pulse of the input leaves."""
    tick = np.zeros_like(search)
    for _ in range(searches):
        tick = tick + search + search @ tick
    pulse = tick[:, input_index].copy()
    pulse[input_index] = 0.0
    tick[:, input_index] = tick[input_index] = 0.0
    powers, pulses = [tick], [pulse]
    for _ in range(2 * TICKS - 2):
        powers.append(powers[-1] + tick + tick @ powers[-1])
        pulses.append(pulses[-1] + tick @ pulses[-1])
    return powers, pulses


def _step(mode: _Mode, ticks: int) -> Array:
    """(n + 8, n): change of the state after so many ticks, transposed."""
    power = mode.powers[ticks - 1]
    late = np.zeros((TICKS, len(power)))
    late[:ticks] = mode.pulses[ticks - 1 :: -1]
    return np.vstack([power.T, late])


def _watched(mode: _Mode, room: int) -> tuple[Array, NDArray[np.int64], int]:
    """Lanes as columns, of those states on which they depend and the inputs; an order of the states that begins with
    those, and the number of both."""
    seen = mode.seen(mode.lanes).reshape(len(mode.owners) * TICKS, -1).T
    n = len(seen) - TICKS
    needed = seen[:n].any(axis=1)
    order, eights = np.argsort(~needed, kind="stable"), -(-int(np.count_nonzero(needed)) // 8)
    count = min(8 * eights, n)
    columns = np.zeros((n + TICKS, room * TICKS))
    columns[: count + TICKS, : seen.shape[1]] = np.vstack([seen[order[:count]], seen[n:]])
    return columns, order.astype(np.int64), count + TICKS


def _changes(mode: _Mode, room: int) -> tuple[Array, bool]:
    """(G, n + 8): the largest change of each guard in a block, of the sizes of state and inputs; True where none loses
    half of its own terms."""
    seen, slow = mode.seen(mode.lanes), True
    changes = np.zeros((room, seen.shape[2]))
    for g, guard in enumerate(mode.rows):
        row = np.append(guard, np.zeros(TICKS))
        changes[g] = np.abs(seen[:, np.array(mode.owners) == g] - row).max(axis=(0, 1))
        slow = slow and bool(np.all(changes[g][row != 0.0] <= 0.5 * np.abs(row[row != 0.0])))
    return changes, slow


@inlined
def _product(table: Array, base: int, stride: int, rows: int, x: Array, out: Array) -> None:
    """``out[r] = sum of table[base + j * stride + r] * x[j]`` for a multiple of eight rows."""
    if x.size == 16:
        wide_product(table, base, stride, rows, x, out)
    else:
        tall_product(table, base, stride, rows, x, out)


@inlined
def begin_block(r: BlockResponses, mode: int, input_index: int, fresh: bool, x: Array, memory: ResponseMemory) -> None:
    """The free response from `x`, whose input becomes zero; `fresh` where the block before ended early."""
    n = x.size
    x[input_index] = 0.0
    for i in range(np.uint64(n)):
        memory.start[i] = x[i]
    now = memory.position[:TICKS]
    if fresh:
        tall_product(r.position, mode * n * TICKS, TICKS, TICKS, x, now)
    else:
        # Those of the next block are known by now, so that its first tick need not wait for the state.
        for k in range(np.uint64(TICKS)):
            now[k] = memory.position[np.uint64(TICKS) + k]
    _product(r.ahead, mode * n * (n + TICKS), n + TICKS, n + TICKS, x, memory.ahead)
    for k in range(np.uint64(TICKS)):
        memory.position[np.uint64(TICKS) + k] = memory.ahead[k]


@inlined
def hold_input(r: BlockResponses, mode: int, j: int, u: float, memory: ResponseMemory) -> None:
    """Add the response to the input of tick j, but for the position one tick later."""
    at = np.uint64(mode * 4 * TICKS + 2 * TICKS) - np.uint64(j)
    for k in range(np.uint64(memory.position.size)):
        memory.position[k] += r.pulse[at + k] * u
    memory.start[np.uint64(memory.start.size - TICKS) + np.uint64(j)] = u


@inlined
def calm_ticks(t: Tables, r: BlockResponses, mode: int, ticks: int, x: Array, memory: ResponseMemory) -> int:
    """Number of ticks, at most `ticks`, before the first in which some guard may fire; `x` as the block began."""
    n, lanes, z = t.states, r.lane_count[mode], memory.start
    if r.slow[mode]:
        near = False
        for g in range(t.guard_count[mode]):
            guard = mode * t.guards + g
            near = near or dot(t.rows, guard * n, x) + dot_sizes(r.reach, guard * (n + TICKS), z) >= 0.0
        if not near:
            return ticks
    count, stride = r.column_count[mode], r.lanes * TICKS
    seen, states, base = memory.seen[:count], np.uint64(count - TICKS), np.uint64(mode * n)
    for k in range(states):
        seen[k] = z[np.uint64(r.columns[base + k])]
    for k in range(np.uint64(TICKS)):
        seen[states + k] = z[np.uint64(n) + k]
    _product(r.watch, mode * (n + TICKS) * stride, stride, lanes * TICKS, seen, memory.watch)
    positive = 0
    for k in range(np.uint64(ticks * lanes)):
        positive += memory.watch[k] > 0.0
    if positive == 0:
        return ticks
    calm = ticks
    for lane in range(lanes):
        bound = LINGERING * rounding(t, mode, r.guard[mode, lane], 0, x)
        for j in range(calm):
            if memory.watch[j * lanes + lane] > bound:
                calm = j
                break
    return calm


@inlined
def advance_block(r: BlockResponses, mode: int, ticks: int, x: Array, memory: ResponseMemory) -> None:
    """Advance `x`, which may be the start in `memory`, by the first ticks of a block."""
    n, z = x.size, memory.start
    tall_product(r.step, (mode * TICKS + ticks - 1) * z.size * n, n, n, z, memory.change)
    for i in range(np.uint64(n)):
        x[i] += memory.change[i]


@inlined
def end_block(r: BlockResponses, mode: int, ticks: int, x: Array, memory: ResponseMemory) -> None:
    """Advance `x` by the first ticks of the block that began with it."""
    n = x.size
    if ticks == TICKS:
        tall_product(r.input_change, mode * TICKS * n, n, n, memory.start[n:], memory.change)
        for i in range(np.uint64(n)):
            x[i] += memory.ahead[np.uint64(TICKS) + i] + memory.change[i]
    elif ticks > 0:
        for j in range(ticks, TICKS):
            memory.start[n + j] = 0.0
        advance_block(r, mode, ticks, x, memory)
