"""The compiled side of an ensemble: for one automaton after the other fill its tables, run its members, sample their
outputs and reduce these to figures."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.build import begin_tables, fill_entered
from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.hybrid.flow import Scratch
from servotwin.hybrid.kernel import DONE, ZENO, RunRecord, flow_until, follow_guards
from servotwin.hybrid.output import Outputs, OutputWorkspace, fill_output, sample_segments
from servotwin.hybrid.tables import Tables


class Figures(NamedTuple):
    """Figures of outputs whose samples are not stored; arrays of one shape, ``[..., output]``.

    Attributes
    ----------
    mean_size : array
        Mean of abs(y).
    travel : array
        Sum of abs(y[i] - y[i - 1]).
    outside : array
        Number of samples up to the last one beyond the limit, that one included; 0: none is.
    lowest, highest, mean, mean_square : array
        Of all samples.
    last_lowest, last_highest, last_mean, last_mean_square : array
        Of the last ones.
    """

    mean_size: Array
    travel: Array
    outside: Array
    lowest: Array
    highest: Array
    mean: Array
    mean_square: Array
    last_lowest: Array
    last_highest: Array
    last_mean: Array
    last_mean_square: Array


class AutomatonFamily(NamedTuple):
    """Automata of one structure: the numbers of each."""

    flows: Array  # (A, M * n * n)
    guards: Array  # (A, M * G * n)
    resets: Array  # (A, M * G * n * n), or (1, ...): those of all
    outputs: Array  # (A, O, M * n)
    step: Array  # (A,) search steps, s
    stride: NDArray[np.int64]  # (A,) search steps a sample


class MemberStarts(NamedTuple):
    """Starts of the members."""

    order: NDArray[np.int64]  # (K,) in which to run them: those of one automaton together
    automaton: NDArray[np.int64]  # (K,)
    mode: NDArray[np.int64]  # (K,)
    state: Array  # (K, n)
    limits: Array  # (K, O) outputs beyond them count as outside


class MemberResults(NamedTuple):
    """Results of the members."""

    traces: Array  # (K, O, samples), or (1, O, samples) when only figures are computed
    figures: Array  # (K, O, number of figures), or (0, O, number of figures)
    events: NDArray[np.int64]  # (K,)
    ends: Array  # (K, n) states at the end, or (0, n)


class WorkerMemory(NamedTuple):
    """Memory of one worker, reused for every automaton and member."""

    tables: Tables
    outputs: Outputs
    block: OutputWorkspace
    scratch: Scratch
    state: Array
    loaded: NDArray[np.int64]  # (1,) automaton that the tables are those of; -1: none


@inlined
def output(memory: WorkerMemory, o: int) -> Outputs:
    """One of the outputs."""
    every = memory.outputs
    return Outputs(every.table[o], every.place[o], every.order[o], every.used[o])


@subroutine
def load(family: AutomatonFamily, a: int, memory: WorkerMemory) -> None:
    """Make the tables those of automaton `a`, each to be filled when it is needed."""
    begin_tables(memory.scratch.pending, a)
    for o in range(family.outputs.shape[1]):
        place = memory.outputs.place[o]
        for m in range(len(place)):
            place[m] = -1
    memory.loaded[0] = a


@subroutine
def fill_sampled(family: AutomatonFamily, a: int, record: RunRecord, memory: WorkerMemory) -> None:
    """Fill the outputs of the modes in which the run just recorded was."""
    for s in range(record.size[0]):
        m = record.mode[s]
        for o in range(family.outputs.shape[1]):
            if memory.outputs.place[o, m] < 0:
                fill_output(memory.tables, m, family.outputs[a, o], family.stride[a], output(memory, o), memory.block)


@subroutine
def sample_all(record: RunRecord, memory: WorkerMemory, stride: int, traces: Array) -> None:
    """Every output of the run just recorded."""
    zero: Any = np.int64(0)  # as in run_members
    for o in range(len(traces)):
        sample_segments(
            zero,
            record.size[0],
            record.step,
            record.fraction,
            record.mode,
            record.state,
            output(memory, o),
            stride,
            zero,
            memory.scratch.change,
            traces[o],
        )


@subroutine
def _spread(y: Array, out: Array) -> None:
    lowest, highest, total, square = y[0], y[0], 0.0, 0.0
    for value in y:
        lowest, highest = min(lowest, value), max(highest, value)
        total += value
        square += value * value
    out[0], out[1], out[2], out[3] = lowest, highest, total / len(y), square / len(y)


@bare
def figures_of(y: Array, limit: float, tail: int, out: Array) -> None:
    """Fill `out` with the `Figures` of one output."""
    begin = len(y) - tail
    sizes, travel, outside = 0.0, 0.0, 0
    for i in range(len(y)):
        sizes += abs(y[i])
        travel += abs(y[i] - y[max(i - 1, 0)])
        if abs(y[i]) > limit:
            outside = i + 1
    out[0], out[1], out[2] = sizes / len(y), travel, outside
    _spread(y, out[3:7])
    _spread(y[begin:], out[7:11])


@bare
def run_members(
    family: AutomatonFamily,
    starts: MemberStarts,
    results: MemberResults,
    first: int,
    last: int,
    tail: int,
    memory: WorkerMemory,
    record: RunRecord,
) -> tuple[int, int]:
    """Run members at places first .. last - 1 of the order; return the status and the place it concerns. `tail` is the
    number of samples at the end that have figures of their own."""
    t = memory.tables
    # A literal is a type of its own to numba: all that it is given to would be compiled once more.
    begin: Any = np.int64(0)
    forced: Any = np.bool_(True)
    for place in range(first, last):
        k = starts.order[place]
        a = starts.automaton[k]
        # Members come sorted by automaton: most find its tables filled.
        if memory.loaded[0] != a:
            load(family, a, memory)
        for i in range(t.states):
            memory.state[i] = starts.state[k, i]
        traces = results.traces[k if len(results.traces) > 1 else 0]
        steps = (traces.shape[1] - 1) * family.stride[a]
        record.size[0] = record.size[1] = 0
        if memory.scratch.pending.filled[starts.mode[k]] == 0:
            fill_entered(t, starts.mode[k], memory.scratch.pending)
        mode, _ = follow_guards(t, starts.mode[k], memory.state, begin, 0.0, forced, 1.0, record, memory.scratch)
        if mode < 0:
            return ZENO, place
        status, _, _, mode = flow_until(t, memory.state, mode, begin, 0.0, steps, 0.0, record, memory.scratch)
        if status != DONE:
            return status, place
        results.events[k] = record.size[1]
        if len(results.ends) > 0:
            for i in range(t.states):
                results.ends[k, i] = memory.state[i]
        fill_sampled(family, a, record, memory)
        sample_all(record, memory, family.stride[a], traces)
        if len(results.figures) > 0:
            for o in range(len(traces)):
                figures_of(traces[o], starts.limits[k, o], tail, results.figures[k, o])
    return DONE, last
