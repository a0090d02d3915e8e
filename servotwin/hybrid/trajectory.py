"""Running an automaton: exact dense output and a table of events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.build import build_tables
from servotwin.hybrid.flow import new_scratch
from servotwin.hybrid.kernel import FULL, ZENO, RunRecord, follow_schedule, grown, new_record
from servotwin.hybrid.output import Outputs, evaluate, output_table, sample_segments
from servotwin.hybrid.tables import Tables, search_step

# Room of a new record: the system provides the memory that is used, and a copy into more room costs as much as the run.
_SEGMENTS, _EVENTS = 1 << 16, 1 << 14
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
    """Tables of an automaton at one search step, cached for the automata used last."""
    return build_tables(automaton, step)


@lru_cache(maxsize=256)
def outputs_for(automaton: Automaton, step: float, stride: int, rows: bytes) -> Outputs:
    """The table of one output, its rows (M, n) as bytes, cached for the outputs used last."""
    full = np.frombuffer(rows).reshape(automaton.flows.shape[:2])
    return output_table(tables_for(automaton, step), full, stride)


@dataclass
class Trajectory:
    """A resumable run of an automaton on a grid of samples: `advance` continues from the time reached.

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
    first : int
        The sample at which the start is; times and samples count from sample 0.
    """

    automaton: Automaton
    state: Array
    mode: int
    sample_step: float
    refine: int = 1
    first: int = 0
    step: float = field(init=False)
    divisor: int = field(init=False)
    tables: Tables = field(init=False, repr=False)
    record: RunRecord = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sample_step) and self.sample_step > 0.0):
            raise InvalidInput(f"sample_step = {self.sample_step} s: must be positive and finite")
        if self.refine < 1:
            raise InvalidInput(f"refine = {self.refine}: must be an integer of 1 or more")
        self.state = _checked_start(self.automaton, self.state, self.mode)
        step, divisor = search_step(self.automaton, self.sample_step)
        self.step, self.divisor = step / self.refine, divisor * self.refine
        self.tables = tables_for(self.automaton, self.step)
        self.record = new_record(len(self.state), _SEGMENTS, _EVENTS)
        self._scratch = new_scratch(self.tables)
        self._place = np.zeros(1)
        self._at = np.array([self.first * self.divisor, self.mode, 0, 1], dtype=np.int64)
        self._failure = ""

    @property
    def time(self) -> float:
        """Time reached, s."""
        return float((self._at[0] + self._place[0]) * self.step)

    @property
    def samples(self) -> int:
        """Number of samples up to the time reached, that of time 0 included."""
        return int(self._at[0] // self.divisor) + 1

    def advance(self, sample: int, jumps: Sequence[Jump] = ()) -> None:
        """Advance to a sample index through time-ordered `jumps`, all of them between now and that sample.

        Raises
        ------
        InvalidInput
            The sample has passed, or a jump is out of order, out of range or names a state or mode that does not exist.
        ZenoError
            No mode admits flow: the message names the time and the last mode. The run cannot continue; its past stays
        readable.
        """
        if not sample >= self.samples - 1:
            raise InvalidInput(f"sample {sample} is before sample {self.samples - 1}, which was reached already")
        self._check_times(jumps, sample)
        self._follow(*schedule_of(jumps, self.step, self.automaton, sample * self.divisor))

    def _check_times(self, jumps: Sequence[Jump], sample: int) -> None:
        last = self._at[0] + self._place[0]
        for jump in jumps:
            place = jump.time / self.step
            if not last - ON_GRID <= place <= sample * self.divisor + ON_GRID:
                raise InvalidInput(
                    f"jump at {jump.time} s: must be in time order, from {self.time:.9g} s, the time reached, to "
                    f"{sample * self.sample_step:.9g} s, the end of this advance"
                )
            last = max(last, place)

    def _follow(self, steps: NDArray[np.int64], fractions: Array, values: Array, modes: NDArray[np.int64]) -> None:
        if self._failure:
            raise ZenoError(self._failure)
        # The schedule is a new one with each call; all else resumes.
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
                self._failure = (
                    f"mode changes without end at t = {self.time:.9g} s, last from mode {name!r}: "
                    "the automaton is Zeno or slides"
                )
                raise ZenoError(self._failure)
            if status != FULL:
                break
            self.record = grown(self.record)
        self.mode = int(self._at[1])

    def set(self, values: dict[int, float], mode_map: Sequence[int] | None = None) -> None:
        """Set states now; guards that this makes positive are followed at the next advance."""
        _check_jump(self.automaton, values, mode_map)
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
        if not self.first <= first <= stop <= self.samples:
            raise InvalidInput(f"samples {first} .. {stop} are outside {self.first} .. {self.samples}")
        outputs = self._outputs(rows)
        result = np.empty(stop - first) if out is None else out
        if result.shape != (stop - first,):
            raise InvalidInput(f"out has shape {result.shape}; it must be ({stop - first},)")
        r, size = self.record, int(self.record.size[0])
        begin = max(int(np.searchsorted(r.step[:size], first * self.divisor, side="left")) - 1, 0)
        sample_segments(
            begin, size, r.step, r.fraction, r.mode, r.state, outputs, self.divisor, first, self._scratch.change, result
        )
        return result

    def at(self, times: ArrayLike, rows: ArrayLike) -> Array:
        """One linear output at any times (s) within the run, right-continuous; ``(len(times),)``."""
        places = np.asarray(times, dtype=float) / self.step
        begin = self.first * self.divisor
        if not np.all((places >= begin) & (places <= self._at[0] + self._place[0] + ON_GRID)):
            raise InvalidInput(
                f"some of the times are outside {begin * self.step:.9g} .. {self.time:.9g} s, the run so far"
            )
        r, size = self.record, int(self.record.size[0])
        starts = r.step[:size] + r.fraction[:size]
        segments = np.maximum(np.searchsorted(starts, places, side="right") - 1, 0)
        # A writable copy: for read-only or strided rows the function would be compiled once more.
        rows = np.array(np.broadcast_to(rows, (len(self.automaton.modes), len(self.state))), dtype=float, order="C")
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

    def _outputs(self, rows: ArrayLike) -> Outputs:
        full = np.broadcast_to(np.asarray(rows, dtype=float), self.automaton.flows.shape[:2])
        return outputs_for(self.automaton, self.step, self.divisor, full.tobytes())

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
        _check_jump(automaton, jump.values, jump.mode_map)
        for index, value in jump.values.items():
            values[j, index] = value
        if jump.mode_map is not None:
            modes[j] = jump.mode_map
    return steps, np.where(near, 0.0, times - np.floor(times)), values, modes


def _checked_start(automaton: Automaton, state: ArrayLike, mode: int) -> Array:
    start = np.array(state, dtype=float)
    if start.shape != (len(automaton.names),):
        raise InvalidInput(f"state has shape {start.shape}; it must be ({len(automaton.names)},)")
    if not np.isfinite(start).all():
        raise InvalidInput("state holds a number that is not finite")
    if not 0 <= mode < len(automaton.modes):
        raise InvalidInput(f"mode = {mode}: modes are 0 to {len(automaton.modes) - 1}")
    return start


def _check_jump(automaton: Automaton, values: dict[int, float], mode_map: Sequence[int] | None) -> None:
    for index, value in values.items():
        if not 0 <= index < len(automaton.names):
            raise InvalidInput(f"a jump sets state {index}; states are 0 to {len(automaton.names) - 1}")
        if not math.isfinite(value):
            raise InvalidInput(f"a jump sets state {automaton.names[index]!r} to {value}; it must be finite")
    count = len(automaton.modes)
    if mode_map is not None and not (len(mode_map) == count and all(0 <= mode < count for mode in mode_map)):
        raise InvalidInput(f"mode map {list(mode_map)} must give one of modes 0 to {count - 1} for each of them")
