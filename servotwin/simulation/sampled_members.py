"""The compiled side of an ensemble of sampled loops: run members, sample their outputs, reduce these to figures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.law import LawParameters
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.build import begin_tables, fill_entered
from servotwin.hybrid.compiled import bare, subroutine
from servotwin.hybrid.flow import Scratch
from servotwin.hybrid.kernel import DONE, RunRecord
from servotwin.hybrid.members import figures_of
from servotwin.hybrid.tables import Tables
from servotwin.simulation.lifted import (
    TICKED,
    UNFILLED,
    Segments,
    latest_direction,
    note,
    run_lifted,
    set_reference,
    take_tick,
)
from servotwin.simulation.lifted_output import sample_lifted
from servotwin.simulation.lifted_tables import LiftedLoop, LiftedMemory, Place, Places, fill_here

_LATE = 1e-9  # ticks: a knot that rounding puts behind the tick it belongs to


class SampledFamily(NamedTuple):
    """Plants of one structure and laws."""

    flows: Array  # (A, M * n * n)
    guards: Array  # (A, M * G * n)
    resets: Array  # (A, M * G * n * n), or (1, ...): those of all
    step: Array  # (A,) of the search, s
    searches: NDArray[np.int64]  # (A,) search steps a tick
    laws: Array  # (C, number of parameters)
    rate: Array  # (C,) ticks/s
    rows: Array  # (O, N) outputs of the state after the tick
    times: Array  # (P,) pieces of the reference's shape
    coefficients: Array  # (P, 4)
    dead_zone: bool
    mode: int  # at the start
    modes: int


class SampledStarts(NamedTuple):
    """Starts of the members."""

    order: NDArray[np.int64]  # (K,) in which to run them: those of one plant and law together
    plant: NDArray[np.int64]  # (K,)
    law: NDArray[np.int64]  # (K,)
    state: Array  # (K, N)
    reference: Array  # (K,) factors of the shape
    enter: Array  # (K,)
    leave: Array  # (K,)
    resolution: Array  # (K,) m, of the position sensor; 0: it is ideal
    limits: Array  # (K, O)


class SampledResults(NamedTuple):
    """Results of the members: samples, or figures of each output."""

    traces: Array  # (K, O, samples), or (1, O, samples) when only figures are computed
    figures: Array  # (K, O, number of figures), or (0, ...)


class SampledWorker(NamedTuple):
    """Memory of one worker, reused for every member."""

    tables: Tables
    lifted: LiftedMemory
    scratch: Scratch
    state: Array
    place: Place
    loaded: NDArray[np.int64]  # (2,) plant and law whose tables these are; -1: none
    coefficients: Array
    filled: NDArray[np.int8]  # (O, slots)
    outputs: Array  # (O, slots * 128 * N)


@subroutine
def load(family: SampledFamily, plant: int, law: int, worker: SampledWorker) -> None:
    """Make the tables those of a plant and a law."""
    if worker.loaded[0] != plant:
        begin_tables(worker.scratch.pending, plant)
        fill_entered(worker.tables, family.mode, worker.scratch.pending)
    elif worker.loaded[1] == law:
        return
    worker.loaded[0], worker.loaded[1] = plant, law
    for slot in range(len(worker.lifted.filled)):
        worker.lifted.filled[slot] = 0
        for o in range(len(worker.filled)):
            worker.filled[o, slot] = 0


@subroutine
def run_one(
    family: SampledFamily,
    starts: SampledStarts,
    k: int,
    places: Places,
    end: int,
    worker: SampledWorker,
    segments: Segments,
    record: RunRecord,
) -> int:
    """Run one member, the tick at `end` included."""
    plant, law, z = starts.plant[k], starts.law[k], worker.state
    p, rate = family.laws[law], family.rate[law]
    parameters = LawParameters(
        p[0], p[1], p[2], p[3], starts.enter[k], starts.leave[k], p[6], p[7], p[8], p[9], p[10], p[11], p[12], p[13],
        p[14], p[15], p[16], p[17], p[18], p[19],
    )  # fmt: skip
    loop = LiftedLoop(
        parameters, family.dead_zone, family.searches[plant], family.step[plant], family.flows[plant], family.modes,
        starts.resolution[k],
    )  # fmt: skip
    for i in range(places.states):
        z[i] = starts.state[k, i]
    for i in range(len(worker.place.at)):
        worker.place.at[i] = 0
    worker.place.at[1], worker.place.at[2], worker.place.sign[0] = family.mode, 1, 0.0
    # What a run uses must not depend on the runs before it: neither would its rounding.
    for slot in range(len(worker.lifted.vast)):
        worker.lifted.vast[slot] = 0
    past, direction = z[places.position], 0.0
    segments.size[0] = segments.size[1] = record.size[0] = record.size[1] = 0
    for piece in range(len(family.times)):
        stop = end
        if piece + 1 < len(family.times):
            stop = min(int(np.ceil(family.times[piece + 1] * rate - _LATE)), end)
        if stop <= worker.place.at[0] and stop < end:
            continue
        for i in range(4):
            worker.coefficients[i] = starts.reference[k] * family.coefficients[piece, i]
        if parameters.friction != 0.0:
            # The reference is constant in every piece.
            direction = latest_direction(worker.coefficients[0] - past, direction)
            past = worker.coefficients[0]
            z[places.feedforward] = parameters.feedforward + parameters.friction * direction
        status = UNFILLED
        while status == UNFILLED:
            status = run_lifted(
                worker.tables, loop, places, worker.coefficients, family.times[piece], rate, z, worker.place, stop,
                segments, record, worker.scratch, worker.lifted,
            )  # fmt: skip
            if status == UNFILLED:
                fill_here(worker.tables, loop, places, worker.place, worker.lifted)
        if status != DONE:
            return status
        if stop == end and (piece + 1 == len(family.times) or family.times[piece + 1] * rate - _LATE > end):
            set_reference(places, worker.coefficients, end / rate - family.times[piece], z)
            break
    take_tick(loop, places, z, worker.place)
    note(segments, end, TICKED, z)
    return DONE


@bare
def run_sampled(
    family: SampledFamily,
    starts: SampledStarts,
    results: SampledResults,
    places: Places,
    sample_rate: float,
    first: int,
    last: int,
    tail: int,
    worker: SampledWorker,
    segments: Segments,
    record: RunRecord,
) -> tuple[int, int]:
    """Run members at places first .. last - 1 of the order; return the status and the place it concerns."""
    for at in range(first, last):
        k = starts.order[at]
        load(family, starts.plant[k], starts.law[k], worker)
        traces = results.traces[k if len(results.traces) > 1 else 0]
        stride = int(np.rint(family.rate[starts.law[k]] / sample_rate))
        end = (traces.shape[1] - 1) * stride
        status = run_one(family, starts, k, places, end, worker, segments, record)
        if status != DONE:
            return status, at
        sample_lifted(
            segments, worker.lifted, places, family.rows, end + 1, stride, worker.filled, worker.outputs, traces
        )
        if len(results.figures) > 0:
            for o in range(len(traces)):
                figures_of(traces[o], starts.limits[k, o], tail, results.figures[k, o])
    return DONE, last
