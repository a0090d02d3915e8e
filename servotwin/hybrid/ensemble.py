"""Many runs of one automaton from many starts, on several threads: one set of tables serves all."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.compiled import bare
from servotwin.hybrid.flow import Scratch, new_scratch
from servotwin.hybrid.kernel import DONE, FULL, ZENO, Record, flow_until, grown, new_record, settle
from servotwin.hybrid.output import Outputs, output_table, sample_segments
from servotwin.hybrid.tables import Tables, search_step
from servotwin.hybrid.trajectory import ZenoError, tables_for

_PARTS_PER_WORKER = 8


@bare
def run_members(
    t: Tables,
    states: Array,
    modes: NDArray[np.int64],
    first: int,
    steps: int,
    stride: int,
    outputs: Outputs,
    out: Array,
    events: NDArray[np.int64],
    record: Record,
    scratch: Scratch,
) -> tuple[int, int]:
    """Run members `first` on until all are done; return the status and the member it concerns."""
    for k in range(first, len(states)):
        x = states[k]
        record.size[0] = record.size[1] = 0
        mode = settle(t, modes[k], x, 0, 0.0, True, record, scratch)
        if mode < 0:
            return ZENO, k
        status, _, _, mode = flow_until(t, x, mode, 0, 0.0, steps, 0.0, record, scratch)
        if status != DONE:
            return status, k
        modes[k] = mode
        events[k] = record.size[1]
        size = record.size[0]
        for o in range(len(out[k])):
            one, row = Outputs(outputs.table[o], outputs.order[o], outputs.used[o]), out[k, o]
            sample_segments(
                0, size, record.step, record.fraction, record.mode, record.state, one, stride, 0, scratch.change, row
            )
    return DONE, len(states)


def run_ensemble(
    automaton: Automaton,
    states: ArrayLike,
    modes: ArrayLike,
    sample_step: float,
    samples: int,
    rows: ArrayLike,
    threads: int | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Outputs of every member at every sample.

    Parameters
    ----------
    automaton : Automaton
    states : (K, n) array
        Starts at time 0.
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
    starts, first_modes = _checked_starts(automaton, states, modes)
    step, divisor = search_step(automaton, sample_step)
    tables = tables_for(automaton, step)
    outputs = _output_tables(automaton, tables, rows, divisor)
    out, events = np.empty((len(starts), len(outputs.table), samples)), np.zeros(len(starts), dtype=np.int64)
    workers = max(1, min(threads or os.cpu_count() or 1, len(starts)))
    # Members cost unequally: many small parts keep every worker busy to the end.
    size = max(1, len(starts) // (_PARTS_PER_WORKER * workers))
    parts = [slice(first, first + size) for first in range(0, len(starts), size)]

    def work(part: slice) -> None:
        steps = (samples - 1) * divisor
        run = _run_part(tables, starts[part], first_modes[part], steps, divisor, outputs, out[part], events[part])
        if run < size and part.start + run < len(starts):
            raise ZenoError(f"member {part.start + run} changes mode without end: the automaton is Zeno or slides")

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, parts))
    return (out if np.ndim(rows) == 3 else out[:, 0]), events


def _output_tables(automaton: Automaton, tables: Tables, rows: ArrayLike, divisor: int) -> Outputs:
    """The tables of every output, one above the other."""
    full = np.array(np.broadcast_to(rows, (*np.shape(rows)[:-2], *automaton.flows.shape[:2])), dtype=float, ndmin=3)
    parts = zip(*(output_table(tables, one, divisor) for one in full), strict=True)
    return Outputs(*(np.stack(part) for part in parts))


def _checked_starts(automaton: Automaton, states: ArrayLike, modes: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    starts, first_modes = np.array(states, dtype=float, ndmin=2), np.array(modes, dtype=np.int64, ndmin=1)
    if starts.shape != (len(first_modes), len(automaton.names)):
        raise InvalidInput(f"{starts.shape} states for {len(first_modes)} modes of {len(automaton.names)} states each")
    if not (np.isfinite(starts).all() and np.isin(first_modes, np.arange(len(automaton.modes))).all()):
        raise InvalidInput(f"states must be finite and modes one of 0 to {len(automaton.modes) - 1}")
    return starts, first_modes


def _run_part(
    tables: Tables,
    states: Array,
    modes: NDArray[np.int64],
    steps: int,
    stride: int,
    outputs: Outputs,
    out: Array,
    events: NDArray[np.int64],
) -> int:
    """Run the members of a part; return the one that cannot go on, their number when all are done."""
    record = new_record(states.shape[1])
    scratch, kept, member = new_scratch(tables), states.copy(), 0
    while True:
        status, member = run_members(
            tables, states, modes, member, steps, stride, outputs, out, events, record, scratch
        )
        if status != FULL:
            return int(member)
        record = grown(record)
        states[member] = kept[member]
