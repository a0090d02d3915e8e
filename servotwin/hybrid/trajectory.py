"""Running an automaton, and what comes out: exact dense output and a table of events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.compiled import bare
from servotwin.hybrid.kernel import (
    CHANGES_AT_ONCE,
    EVENTS_PER_STEP,
    FULL,
    ZENO,
    Record,
    Scratch,
    advance,
    advance_fraction,
    follow_schedule,
)
from servotwin.hybrid.polynomial import DEPTH
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, PART_TERMS, TERMS, Tables, build_tables, search_step

_BLOCK = NODES_COARSE * NODES_FINE
# Jumps this close to a search step, in steps, are taken on it.
ON_GRID = 1e-9


class ZenoError(RuntimeError):
    """Infinitely many mode changes in finite time: Zeno behaviour, or sliding along a guard."""


@dataclass(frozen=True)
class Jump:
    """At `time` (s) set states by index; `mode_map[m]` is the mode to go on in from mode m (None: the same)."""

    time: float
    values: dict[int, float]
    mode_map: Sequence[int] | None = None


@lru_cache(maxsize=64)
def tables_for(automaton: Automaton, step: float) -> Tables:
    """Tables of an automaton at one search step; kept for the automata used last."""
    return build_tables(automaton, step)


@dataclass
class Trajectory:
    """A run of an automaton on a grid of samples, resumable: `advance` goes on from where it stands.

    Parameters
    ----------
    automaton : Automaton
    state : (n,) array
        Start at time 0.
    mode : int
        Mode at time 0; guards that are already positive are followed at once.
    sample_step : float
        Spacing of the samples in seconds. The search for events has a step of its own, set by the fastest eigenvalue.
    refine : int
        Divide the search step further (to check that nothing is missed).
    """

    automaton: Automaton
    state: Array
    mode: int
    sample_step: float
    refine: int = 1
    step: float = field(init=False)
    divisor: int = field(init=False)
    tables: Tables = field(init=False, repr=False)
    record: Record = field(init=False, repr=False)

    def __post_init__(self) -> None:
        step, divisor = search_step(self.automaton, self.sample_step)
        self.step, self.divisor = step / self.refine, divisor * self.refine
        self.tables = tables_for(self.automaton, self.step)
        self.state = np.array(self.state, dtype=float)
        self.record = new_record(len(self.state), 4 * EVENTS_PER_STEP, 4 * EVENTS_PER_STEP)
        self._scratch = new_scratch(self.tables)
        self._place = np.zeros(1)
        self._at = np.array([0, self.mode, 0, 1], dtype=np.int64)
        self._rows: dict[bytes, Array] = {}

    @property
    def time(self) -> float:
        """Time reached, s."""
        return float((self._at[0] + self._place[0]) * self.step)

    @property
    def samples(self) -> int:
        """Number of samples up to the time reached, that of time 0 included."""
        return int(self._at[0] // self.divisor) + 1

    def advance(self, sample: int, jumps: Sequence[Jump] = ()) -> None:
        """Go on to a sample index through time-ordered `jumps`, all of them later than now and not after that sample.

        Raises
        ------
        ZenoError
            With the time and the mode at which no flow is admitted.
        """
        self._follow(*schedule_of(jumps, self.step, self.automaton, sample * self.divisor))

    def _follow(self, steps: NDArray[np.int64], fractions: Array, values: Array, modes: NDArray[np.int64]) -> None:
        self._at[2] = 0
        while True:
            status = follow_schedule(
                self.tables,
                self.state,
                self._place,
                self._at,
                steps,
                fractions,
                values,
                modes,
                self.record,
                self._scratch,
            )
            if status == ZENO:
                name = self.automaton.modes[int(self.record.event_mode[self.record.size[1] - 1])].name
                raise ZenoError(
                    f"mode changes without end at t = {self.time:.9g} s, last from mode {name!r}: "
                    "the automaton is Zeno or slides"
                )
            if status != FULL:
                break
            self.record = grown(self.record)
        self.mode = int(self._at[1])

    def set(self, values: dict[int, float], mode_map: Sequence[int] | None = None) -> None:
        """Set states now; guards that this makes positive are followed at the next advance."""
        for index, value in values.items():
            self.state[index] = value
        if mode_map is not None:
            self._at[1] = self.mode = mode_map[self.mode]
        self._at[3] = 1

    def sampled(self, rows: ArrayLike, first: int = 0, last: int | None = None, out: Array | None = None) -> Array:
        """One linear output at samples first .. last - 1 (all so far by default).

        Parameters
        ----------
        rows : (n,) or (M, n) array
            The output ``rows[mode] @ x``; one row serves all modes.
        first, last : int
            Within 0 .. `samples`.
        out : (last - first,) array, optional
            Buffer to fill.

        Returns
        -------
        (last - first,) array
        """
        stop = self.samples if last is None else last
        if not 0 <= first <= stop <= self.samples:
            raise InvalidInput(f"samples {first} .. {stop} are outside 0 .. {self.samples}")
        table = self._output_table(rows)
        result = np.empty(stop - first) if out is None else out
        if result.shape != (stop - first,):
            raise InvalidInput(f"out has shape {result.shape}; it must be ({stop - first},)")
        r, size = self.record, int(self.record.size[0])
        begin = max(int(np.searchsorted(r.step[:size], first * self.divisor, side="left")) - 1, 0)
        sample_segments(begin, size, r.step, r.fraction, r.mode, r.state, table, self.divisor, first, result)
        return result

    def at(self, times: ArrayLike, rows: ArrayLike) -> Array:
        """The same output at any times within the run, right-continuous; ``(len(times),)``."""
        places = np.asarray(times, dtype=float) / self.step
        r, size = self.record, int(self.record.size[0])
        starts = r.step[:size] + r.fraction[:size]
        segments = np.maximum(np.searchsorted(starts, places, side="right") - 1, 0)
        rows = np.broadcast_to(np.asarray(rows, dtype=float), (len(self.automaton.modes), len(self.state)))
        result = np.empty(len(places))
        evaluate(
            self.tables,
            segments,
            places - starts[segments],
            r.mode,
            r.state,
            rows,
            result,
            np.empty(len(self.state)),
            self._scratch,
        )
        return result

    def _output_table(self, rows: ArrayLike) -> Array:
        full = np.ascontiguousarray(np.broadcast_to(rows, (len(self.automaton.modes), len(self.state))), dtype=float)
        key = full.tobytes()
        if key not in self._rows:
            self._rows[key] = output_table(self.tables, full)
        return self._rows[key]

    @cached_property
    def labels(self) -> list[list[tuple[str, int]]]:
        """Label and side of every guard of every mode."""
        return [[(guard.label, guard.side) for guard in mode.guards] for mode in self.automaton.modes]

    def events(self) -> list[tuple[float, str, int, bool]]:
        """Every event so far: time (s), label, side, and whether a jump forced it."""
        r, size = self.record, int(self.record.size[1])
        times = (r.event_step[:size] + r.event_fraction[:size]) * self.step
        triples = zip(times.tolist(), r.event_mode[:size], r.event_guard[:size], r.event_forced[:size], strict=True)
        return [(time, *self.labels[mode][guard], bool(forced)) for time, mode, guard, forced in triples]


def schedule_of(
    jumps: Sequence[Jump], step: float, automaton: Automaton, end: int
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Jumps as the kernel's arrays: step, fraction, states to set (NaN keeps) and mode map, with a last row for the
    end."""
    times = np.array([jump.time / step for jump in jumps] + [float(end)])
    whole = np.rint(times)
    near = np.abs(times - whole) <= ON_GRID
    steps = np.where(near, whole, np.floor(times)).astype(np.int64)
    values = np.full((len(times), len(automaton.names)), np.nan)
    modes = np.tile(np.arange(len(automaton.modes)), (len(times), 1))
    for j, jump in enumerate(jumps):
        for index, value in jump.values.items():
            values[j, index] = value
        if jump.mode_map is not None:
            modes[j] = jump.mode_map
    return steps, np.where(near, 0.0, times - np.floor(times)), values, modes


def new_record(n: int, segments: int, events: int) -> Record:
    """An empty record with room for so many segments and events."""
    return Record(
        np.zeros(2, dtype=np.int64),
        np.empty(segments, dtype=np.int64),
        np.empty(segments),
        np.empty(segments, dtype=np.int64),
        np.empty((segments, n)),
        np.empty(events, dtype=np.int64),
        np.empty(events),
        np.empty(events, dtype=np.int64),
        np.empty(events, dtype=np.int64),
        np.empty(events, dtype=bool),
    )


def grown(record: Record) -> Record:
    """A copy with twice the room."""
    larger = new_record(record.state.shape[1], 2 * len(record.step), 2 * len(record.event_step))
    for old, new in zip(record, larger, strict=True):
        new[: len(old)] = old
    return larger


def new_scratch(tables: Tables) -> Scratch:
    """Working memory for one run."""
    n = tables.states
    rows = max(tables.guards * (3 * NODES_COARSE + 1), n + 4 * tables.guards)
    sizes = (rows, TERMS, n, n * PART_TERMS, DEPTH + 2, DEPTH + 2)
    return Scratch(*(np.zeros(size) for size in sizes))


def output_table(tables: Tables, rows: Array) -> Array:
    """Rows ``rows[m] @ exp(A_m j h)`` for j = 0 .. 127, flat ``(M, n, 128)``."""
    n, modes = tables.states, len(tables.guard_count)
    # Stored transposed: [m, j, k, i] is element (i, k) of the deviation.
    fine = tables.jump_fine.reshape(modes, NODES_FINE, n, n)
    coarse = tables.jump_coarse.reshape(modes, NODES_COARSE, n, n)
    eights = rows[:, None] + np.einsum("mjki,mi->mjk", coarse[:, :-1], rows)
    starts = np.concatenate([rows[:, None], eights], axis=1)
    ones = starts[:, :, None] + np.einsum("mjki,mli->mljk", fine[:, :-1], starts)
    table = np.concatenate([starts[:, :, None], ones], axis=2).reshape(modes, _BLOCK, n)
    return np.ascontiguousarray(table.transpose(0, 2, 1)).ravel()


@bare
def sample_segments(
    begin: int,
    size: int,
    step: NDArray[np.int64],
    fraction: Array,
    mode: NDArray[np.int64],
    state: Array,
    table: Array,
    stride: int,
    first: int,
    out: Array,
) -> None:
    """Write the output at samples `first` on, one every `stride` search steps, from the segments that start on the
    grid."""
    n, last = state.shape[1], first + len(out)
    block = np.uint64(_BLOCK)
    for s in range(begin, size):
        if fraction[s] > 0.0:
            continue
        end = step[s] + 1
        if s + 1 < size:
            end = step[s + 1] + (1 if fraction[s + 1] > 0.0 else 0)
        low, high = max(first, -(-step[s] // stride)), min(last, -(-end // stride))
        if high <= low:
            if low >= last:
                break
            continue
        at = np.uint64(mode[s] * n * _BLOCK + low * stride - step[s])
        length, base = np.uint64(high - low), np.uint64(low - first)
        for j in range(length):
            out[base + j] = 0.0
        if stride == 1:
            for i in range(n):
                factor = state[s, i]
                for j in range(length):
                    out[base + j] += table[at + j] * factor
                at += block
        else:
            every = np.uint64(stride)
            for i in range(n):
                for j in range(length):
                    out[base + j] += table[at + j * every] * state[s, i]
                at += block


@bare
def evaluate(
    t: Tables,
    segments: NDArray[np.int64],
    offsets: Array,
    mode: NDArray[np.int64],
    state: Array,
    rows: Array,
    out: Array,
    x: Array,
    scratch: Scratch,
) -> None:
    """Dense output: advance each segment's start by an offset in steps and apply the row of its mode."""
    n2 = t.states * t.states
    for k in range(len(segments)):
        m = mode[segments[k]]
        for i in range(t.states):
            x[i] = state[segments[k], i]
        whole = int(offsets[k])
        eights, ones = min(whole // NODES_FINE, NODES_COARSE), 0
        ones = min(whole - eights * NODES_FINE, NODES_FINE)
        if eights > 0:
            advance(t.jump_coarse, (m * NODES_COARSE + eights - 1) * n2, x, scratch.change)
        if ones > 0:
            advance(t.jump_fine, (m * NODES_FINE + ones - 1) * n2, x, scratch.change)
        advance_fraction(t, m, x, offsets[k] - whole, scratch)
        total = 0.0
        for i in range(t.states):
            total += rows[m, i] * x[i]
        out[k] = total


__all__ = ["CHANGES_AT_ONCE", "Jump", "Trajectory", "ZenoError"]
