"""Many runs from many starts, of one automaton or of many with one structure, on several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton, AutomatonStack, shared_flows, speeds, structure_key
from servotwin.hybrid.buffer_pool import BufferPool
from servotwin.hybrid.flow import new_scratch
from servotwin.hybrid.kernel import DONE, ZENO, RunRecord, grown, new_record
from servotwin.hybrid.members import AutomatonFamily, Figures, MemberResults, MemberStarts, WorkerMemory, run_members
from servotwin.hybrid.output import empty_outputs, new_output_workspace
from servotwin.hybrid.tables import NODES_FINE, divisors, empty_tables
from servotwin.hybrid.trajectory import ZenoError

_PARTS_PER_WORKER = 8

_Result = TypeVar("_Result")


class Members(NamedTuple):
    """Starts of the runs, and the automaton of each.

    Attributes
    ----------
    automaton : (K,) array
        Index of each member's automaton.
    mode : (K,) array
        Modes at time 0.
    state : (K, n) array
        States at time 0.
    """

    automaton: NDArray[np.int64]
    mode: NDArray[np.int64]
    state: Array


@dataclass(frozen=True)
class FigureOptions:
    """Options of figures: ``limits`` (K, O) beyond which an output counts as outside, and the number of samples in the
    last part, which has figures of its own."""

    limits: Array
    last: int


def run_ensemble(
    automaton: Automaton,
    states: ArrayLike,
    modes: ArrayLike,
    sample_step: float,
    samples: int,
    rows: ArrayLike,
    threads: int | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Run every member and return its outputs at every sample.

    Parameters
    ----------
    automaton : Automaton
    states : (K, n) array
        States at time 0.
    modes : (K,) array
        Modes at time 0.
    sample_step : float
        s.
    samples : int
        Samples per member, that of time 0 included.
    rows : (n,), (M, n) or (O, M, n) array
        The output ``rows[mode] @ x``, or several of them.
    threads : int, optional
        As many as there are processors by default.

    Returns
    -------
    output : (K, samples) or (K, O, samples) array
    events : (K,) array
        Events of each member.

    Raises
    ------
    ZenoError
        Naming the member.
    """
    starts, first_modes = np.array(states, dtype=float, ndmin=2), np.array(modes, dtype=np.int64, ndmin=1)
    full = np.array(np.broadcast_to(rows, (*np.shape(rows)[:-2], *automaton.flows.shape[:2])), dtype=float, ndmin=3)
    members = Members(np.zeros(len(first_modes), dtype=np.int64), first_modes, starts)
    traces, events = run_family((automaton,), full[None], members, sample_step, samples, threads)
    return (traces if np.ndim(rows) == 3 else traces[:, 0]), events


def run_family(
    automata: Sequence[Automaton] | AutomatonStack,
    rows: Array,
    members: Members,
    sample_step: float,
    samples: int,
    threads: int | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Run every member, each with an automaton of its own, and return its outputs at every sample.

    Parameters
    ----------
    automata : sequence of A Automaton, or AutomatonStack
        Of one structure: states, guards, targets; their numbers differ.
    rows : (A, O, M, n) array
        Outputs ``rows[automaton, o, mode] @ x``.
    members : Members
    sample_step, samples, threads
        As for `run_ensemble`.

    Returns
    -------
    output : (K, O, samples) array
    events : (K,) array

    Raises
    ------
    InvalidInput
        The automata differ in structure, or a member's start, mode or automaton does not exist.
    ZenoError
        Naming the member.
    """
    traces = np.empty((len(members.mode), rows.shape[1], samples))
    results = MemberResults(
        traces, np.empty((0, rows.shape[1], 0)), np.zeros(len(traces), dtype=np.int64), np.empty((0, 0))
    )
    stack = _stacked(automata)
    _run(_family(stack, rows, sample_step), stack.first, members, results, None, threads)
    return traces, results.events


def figures_of_family(
    automata: Sequence[Automaton] | AutomatonStack,
    rows: Array,
    members: Members,
    sample_step: float,
    samples: int,
    options: FigureOptions,
    threads: int | None = None,
    ends: Array | None = None,
) -> Figures:
    """Run the members as `run_family` does and reduce their samples to figures, arrays (K, O).

    `ends` (K, n), where given, becomes the states at the end.
    """
    if not 1 <= options.last <= samples:
        raise InvalidInput(f"the last {options.last} of {samples} samples: must be 1 to {samples}")
    figures = np.empty((len(members.mode), rows.shape[1], len(Figures._fields)))
    traces, events = np.empty((1, rows.shape[1], samples)), np.zeros(len(figures), dtype=np.int64)
    results = MemberResults(traces, figures, events, np.empty((0, 0)) if ends is None else ends)
    stack = _stacked(automata)
    _run(_family(stack, rows, sample_step), stack.first, members, results, options, threads)
    return Figures(*np.moveaxis(figures, 2, 0))


def _stacked(automata: Sequence[Automaton] | AutomatonStack) -> AutomatonStack:
    return automata if isinstance(automata, AutomatonStack) else AutomatonStack.of(automata)


def _family(stack: AutomatonStack, rows: Array, sample_step: float) -> AutomatonFamily:
    strides = divisors(*speeds(stack.flows), sample_step)
    return AutomatonFamily(
        stack.flows.reshape(len(strides), -1),
        stack.rows.reshape(len(strides), -1),
        stack.resets.reshape(len(stack.resets), -1),
        np.array(rows, dtype=float, order="C").reshape(*rows.shape[:2], -1),  # another order is compiled anew
        sample_step / strides,
        strides,
    )


def _run(
    family: AutomatonFamily,
    structure: Automaton,
    members: Members,
    results: MemberResults,
    options: FigureOptions | None,
    threads: int | None,
) -> None:
    """Fill `results`; each worker takes the next part when it has finished one."""
    starts = _checked_starts(structure, len(family.step), members, results, options)
    flow_of = shared_flows(family.flows.reshape(len(family.flows), *structure.flows.shape))
    kind = structure_key(structure), flow_of.tobytes(), family.outputs.shape[1]
    job = _Job(family, structure, flow_of, kind, starts, results, 1 if options is None else options.last)
    count = len(starts.order)
    workers = max(1, min(threads or os.cpu_count() or 1, count))
    # Members cost unequally: many small parts keep every worker busy to the end.
    size = max(1, count // (_PARTS_PER_WORKER * workers))
    # An iterator shared by the threads: the interpreter lock makes taking the next part safe.
    parts = iter([(first, min(first + size, count)) for first in range(0, count, size)])
    stuck = on_threads(lambda: _run_parts(job, parts), workers)
    if zeno := [member for each in stuck for member in each]:
        raise ZenoError(f"member {min(zeno)} changes mode without end: the automaton is Zeno or slides")


class _Job(NamedTuple):
    """Members to be run.

    `kind` is that of the memory that runs need: all automata of this structure share it; `tail` is the number of
    samples at the end that have figures of their own.
    """

    family: AutomatonFamily
    structure: Automaton
    flow_of: NDArray[np.int64]
    kind: Hashable
    starts: MemberStarts
    results: MemberResults
    tail: int


_STOCK: BufferPool[tuple[WorkerMemory, RunRecord]] = BufferPool(most=8)


def _run_parts(job: _Job, parts: Iterator[tuple[int, int]]) -> list[int]:
    """Run parts as one worker while there are any; return the members with Zeno behaviour."""
    family, results, zeno = job.family, job.results, []
    if len(results.figures):
        # Figures need the samples of one member at a time: every worker has its own buffer for them.
        results = results._replace(traces=np.empty_like(results.traces))
    with _STOCK.lent(job.kind, lambda: _new_memory(job)) as (kept, record):
        memory = _loaded(kept, family)
        for first, last in parts:
            while first < last:
                status, first = run_members(family, job.starts, results, first, last, job.tail, memory, record)
                if status == ZENO:
                    zeno.append(int(job.starts.order[first]))
                    break
                if status != DONE:
                    record = grown(record)
    return zeno


def _loaded(memory: WorkerMemory, family: AutomatonFamily) -> WorkerMemory:
    """The memory with the numbers of a family, none of whose tables are filled yet."""
    memory.loaded[:] = -1
    pending = memory.scratch.pending._replace(
        flows=family.flows,
        rows=family.guards,
        resets=family.resets,
        step=family.step,
        reach=np.full(len(family.step), NODES_FINE),
    )
    return memory._replace(scratch=memory.scratch._replace(pending=pending))


def _new_memory(job: _Job) -> tuple[WorkerMemory, RunRecord]:
    tables = empty_tables(job.structure, job.flow_of)
    memory = WorkerMemory(
        tables,
        empty_outputs(tables, job.family.outputs.shape[1]),
        new_output_workspace(tables.states),
        new_scratch(tables),
        np.zeros(tables.states),
        np.full(1, -1),
    )
    return memory, new_record(tables.states)


def _checked_starts(
    structure: Automaton, automata: int, members: Members, results: MemberResults, options: FigureOptions | None
) -> MemberStarts:
    which, modes, states = members
    n, count = len(structure.names), len(structure.modes)
    if states.shape != (len(modes), n):
        raise InvalidInput(f"{states.shape} states for {len(modes)} modes of {n} states each")
    if not (np.isfinite(states).all() and np.isin(modes, np.arange(count)).all()):
        raise InvalidInput(f"states must be finite and modes one of 0 to {count - 1}")
    if which.shape != modes.shape or not np.isin(which, np.arange(automata)).all():
        raise InvalidInput(f"every member needs an automaton of 0 to {automata - 1}")
    limits = np.zeros((len(modes), results.traces.shape[1])) if options is None else options.limits
    # Sorted by automaton, so that its tables are filled once for all of its members.
    return MemberStarts(np.argsort(which, kind="stable"), which, modes, states, limits)


def on_threads(work: Callable[[], _Result], workers: int) -> list[_Result]:
    """Do the same work so many times at once, and return all results.

    The calling thread takes part: ensembles are mostly so short that the start of a thread counts.

    Parameters
    ----------
    work : callable
    workers : int
        1 or more.
    """
    if workers == 1:
        return [work()]
    with ThreadPoolExecutor(workers - 1) as pool:
        others = [pool.submit(work) for _ in range(workers - 1)]
        own = work()
        return [own, *(other.result() for other in others)]
