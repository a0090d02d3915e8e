"""Members of a sampled ensemble by structure, and the threads that run them in blocks of ticks."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.control.law import LawParameters
from servotwin.control.laws import Law, filtered_pid
from servotwin.hybrid.automaton import Array, structure_key
from servotwin.hybrid.buffer_pool import BufferPool
from servotwin.hybrid.ensemble import on_threads
from servotwin.hybrid.flow import new_scratch
from servotwin.hybrid.kernel import CHANGES_AT_ONCE, DONE, EVENTS_PER_STEP, ZENO, RunRecord, grown, new_record
from servotwin.hybrid.lifted import BLOCK, lifted_counts, lifted_in
from servotwin.hybrid.tables import cut, divisors, empty_tables, room_for, zeros
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.automaton import ServoAutomaton, degree
from servotwin.plant.plants import Plant, structure_of
from servotwin.plant.signals import PiecewiseCubic
from servotwin.plant.stack import LoopStack, sampled_plants
from servotwin.simulation.ensemble_starts import starts_of
from servotwin.simulation.lifted import Segments, more_segments, new_segments
from servotwin.simulation.lifted_engine import memory_around, places_of, start_law, watches_of
from servotwin.simulation.lifted_tables import KINDS, Place, Places
from servotwin.simulation.sampled_members import (
    SampledFamily,
    SampledResults,
    SampledStarts,
    SampledWorker,
    run_sampled,
)

_PARTS_PER_WORKER = 8
_ROOM = 1 << 13


@dataclass(frozen=True)
class SampledMembers:
    """All members, flat; `shape` is what servos, controllers and constants broadcast to."""

    shape: tuple[int, ...]
    servos: list[Plant]
    controllers: list[Law]
    constants: dict[str, Array]


@dataclass(frozen=True)
class SampledSpan:
    """Time and outputs of the runs: shape of the reference over time, samples, their rate (Hz), names of the outputs,
    and the number of samples in the last part."""

    shape: PiecewiseCubic
    samples: int
    rate: float
    outputs: tuple[str, ...]
    last: int


@dataclass(frozen=True)
class SampledGroup:
    """Members of one structure: `which` are their indices among all members; `flow_of` tells which modes flow alike,
    and `kind` is that of the memory that runs need: all groups of this structure share it."""

    which: NDArray[np.int64]
    loop: ServoAutomaton
    places: Places
    watches: int
    family: SampledFamily
    starts: SampledStarts
    flow_of: NDArray[np.int64]
    kind: Hashable


def in_blocks(members: SampledMembers, span: SampledSpan) -> list[bool]:
    """True for each member that advances in blocks: a filtered PID with readings of the instant, and ticks at every
    sample of the output; with a friction feedforward a reference that is constant in every piece."""
    constant = degree(span.shape) == 0
    # Members share laws, and many share a servo.
    plants = {id(each): each for each in members.servos}
    servos = {key: not (_hangs(servo) or servo.sensors.fed_back(servo.p).delay) for key, servo in plants.items()}
    laws = {
        key: _in_blocks(law, span, constant) for key, law in {id(each): each for each in members.controllers}.items()
    }
    return [servos[id(servo)] and laws[id(law)] for servo, law in zip(members.servos, members.controllers, strict=True)]


def _hangs(servo: Plant) -> bool:
    """True where the flank on which a load hangs depends on the gap."""
    return servo.at_motor and bool(servo.guide.force)


def _in_blocks(law: Law, span: SampledSpan, constant: bool) -> bool:
    if not isinstance(law, Controller) or (law.friction_feedforward != 0.0 and not constant):
        return False
    ratio = (law.sample_rate or 0.0) / span.rate
    whole = round(ratio)
    return whole >= 1 and abs(ratio - whole) <= 1e-9 * ratio


def groups_of(members: SampledMembers, span: SampledSpan) -> list[SampledGroup]:
    """Members that advance in blocks, by structure."""
    by_structure: dict[object, list[int]] = {}
    for member, (structure, blocks) in enumerate(zip(_structures(members), in_blocks(members, span), strict=True)):
        if blocks:
            by_structure.setdefault(structure, []).append(member)
    return [_group(members, span, np.array(which)) for which in by_structure.values()]


def _structures(members: SampledMembers) -> Iterator[tuple[object, ...]]:
    """The structure of each member."""
    constants = members.constants
    columns = [constants[name] != 0.0 for name in ("tolerance", "input_bias", "friction", "resolution")]
    switches = zip(*(column.tolist() for column in [*columns, constants["delay"]]), strict=True)
    # Members share laws, and many share a servo.
    servos = {id(servo): structure_of(servo) for servo in {id(each): each for each in members.servos}.values()}
    laws = {id(law): _law_structure(law) for law in {id(each): each for each in members.controllers}.values()}
    for servo, law, switch in zip(members.servos, members.controllers, switches, strict=True):
        yield servos[id(servo)], laws[id(law)], switch


def _law_structure(law: Law) -> tuple[bool, ...]:
    """Members whose law is no filtered PID are in no group."""
    if not isinstance(law, Controller):
        return ()
    limits = law.voltage_limit is None, law.rate_limit is None, law.loop_filter_hz is None
    always = law.feedforward == 0.0 and law.friction_feedforward == 0.0
    return *limits, law.notch_hz == 0.0, always, law.velocity_feedforward == 0.0


def _group(members: SampledMembers, span: SampledSpan, which: NDArray[np.int64]) -> SampledGroup:
    constants = {name: values[which] for name, values in members.constants.items()}
    bias, friction = constants["input_bias"][0] != 0.0, constants["friction"][0] > 0.0
    dead_zone, delay = bool(constants["tolerance"][0] > 0.0), int(constants["delay"][0])
    servos = [members.servos[member] for member in which]
    laws = [filtered_pid(members.controllers[member]) for member in which]
    law_places: dict[Controller, int] = {}
    law = np.array([law_places.setdefault(each, len(law_places)) for each in laws])
    plant_places: dict[tuple[Plant, float], int] = {}
    plant = np.array(
        [
            plant_places.setdefault((servo, each.sample_rate or 0.0), len(plant_places))
            for servo, each in zip(servos, laws, strict=True)
        ]
    )
    loops = sampled_plants([servo for servo, _ in plant_places], 0, bool(bias), bool(friction))
    counts = bool(constants["resolution"][0] > 0.0)
    places = places_of(loops.first, laws[0], delay, degree(span.shape), counts)
    states = np.zeros((len(which), places.states))
    starts = starts_of(loops, plant, constants)
    states[:, : places.plant] = starts.states
    for follower in (places.filtered, places.past, places.counted):
        if follower >= 0:
            states[:, follower] = states[:, places.position]
    if places.feedforward >= 0:
        states[:, places.feedforward] = [each.feedforward for each in laws]
    if starts.commands.any():
        for state, each, command in zip(states, laws, starts.commands.tolist(), strict=True):
            start_law(state, places, each, command)
    rates = np.array([rate for _, rate in plant_places])
    # Loads of one structure hang on one side.
    family = _family(loops, rates, list(law_places), places, span, dead_zone, int(starts.sides[0]))
    thresholds = [each.thresholds(float(t)) for each, t in zip(laws, constants["tolerance"], strict=True)]
    enter, leave = np.array(thresholds).T.copy()
    order = np.lexsort((law, plant))
    limits = np.zeros((len(which), len(span.outputs)))
    begun = SampledStarts(
        order, plant, law, states, constants["reference"], enter, leave, constants["resolution"], limits
    )
    watches, flow_of = watches_of(loops.first, laws[0], dead_zone, counts), loops.automata.shared_flows
    outputs = dead_zone, family.modes, len(span.outputs)
    kind = structure_key(loops.first.automaton), flow_of.tobytes(), places, watches, outputs
    return SampledGroup(which, loops.first, places, watches, family, begun, flow_of, kind)


def _family(
    loops: LoopStack,
    rates: Array,
    laws: list[Controller],
    places: Places,
    span: SampledSpan,
    dead_zone: bool,
    side: int,
) -> SampledFamily:
    stack, period = loops.automata, 1.0 / rates
    searches = divisors(*stack.speeds, period)
    return SampledFamily(
        stack.flows.reshape(len(rates), -1),
        stack.rows.reshape(len(rates), -1),
        stack.resets.reshape(len(stack.resets), -1),
        period / searches,
        searches,
        np.array([tuple(law.law(None)) for law in laws], dtype=float).reshape(-1, len(LawParameters._fields)),
        np.array([law.sample_rate for law in laws], dtype=float),
        np.array([_row(loops.first, name, places) for name in span.outputs]),
        span.shape.times,
        span.shape.coeffs,
        dead_zone,
        loops.first.mode("held", side),
        len(loops.first.automaton.modes),
    )


def _row(loop: ServoAutomaton, name: str, places: Places) -> Array:
    """The output as a row of the state after the tick."""
    row = np.zeros(places.states)
    row[: places.plant] = loop.rows["position" if name == "error" else name][0]
    if name == "error":
        row = -row
        row[places.reference] += 1.0
    return row


class GroupRun(NamedTuple):
    """Members of a group to be run: `limits` (k, O) beyond which an output counts as outside, and their results."""

    group: SampledGroup
    limits: Array
    results: SampledResults


class _Part(NamedTuple):
    """Places of a run's order."""

    run: GroupRun
    first: int
    last: int


class _Memory(NamedTuple):
    """Memory of one worker, all but its large tables."""

    worker: SampledWorker
    segments: Segments
    record: RunRecord


# Groups of all structures share the rooms for large tables, by their size: one a structure took a gigabyte.
_STOCK: BufferPool[_Memory] = BufferPool(most=32)
_ROOMS: BufferPool[Array] = BufferPool(most=4)


def run_groups(runs: Sequence[GroupRun], span: SampledSpan, threads: int | None) -> None:
    """Fill the results of all groups; each worker takes the next part of any when it has finished one.

    Raises
    ------
    ZenoError
        Naming the member.
    """
    count = sum(len(run.group.which) for run in runs)
    workers = max(1, min(threads or os.cpu_count() or 1, count))
    size = max(1, count // (_PARTS_PER_WORKER * workers))
    parts = iter(
        [
            _Part(run, first, min(first + size, len(run.group.which)))
            for run in runs
            for first in range(0, len(run.group.which), size)
        ]
    )
    stuck = on_threads(lambda: _run_parts(parts, span), workers)
    if zeno := [member for each in stuck for member in each]:
        raise ZenoError(f"member {min(zeno)} changes mode without end: the automaton is Zeno or slides")


def _run_parts(parts: Iterator[_Part], span: SampledSpan) -> list[int]:
    """Run parts as one worker while there are any; return the members with Zeno behaviour."""
    zeno = []
    # Parts of one group share the memory, and what is filled in it.
    for _, mine in groupby(parts, key=lambda part: id(part.run)):
        first = next(mine)
        group = first.run.group
        size = 1 << (room_for(_counts(group)) - 1).bit_length()
        with (
            _STOCK.lent(group.kind, partial(_new_memory, group)) as kept,
            _ROOMS.lent(size, partial(zeros, size)) as room,
        ):
            memory = kept._replace(worker=_loaded(kept.worker, group, room))
            zeno += [place for part in chain([first], mine) for place in _run_part(part, span, memory)]
    return zeno


def _run_part(part: _Part, span: SampledSpan, memory: _Memory) -> list[int]:
    """Run the members of a part; return the one with Zeno behaviour, if there is one."""
    (group, limits, results), first, last = part
    starts, (worker, segments, record) = group.starts._replace(limits=limits), memory
    if len(results.figures):
        # Figures need the samples of one member at a time: every part has its own buffer for them.
        results = results._replace(traces=np.empty_like(results.traces))
    while first < last:
        status, first = run_sampled(
            group.family, starts, results, group.places, span.rate, first, last, span.last, worker, segments, record
        )
        if status == ZENO:
            return [int(group.which[starts.order[first]])]
        if status != DONE:
            if record.size[1] > len(record.event_step) - 2 * EVENTS_PER_STEP - CHANGES_AT_ONCE:
                record = grown(record)
            else:
                segments = more_segments(segments)
    return []


def _counts(group: SampledGroup) -> tuple[int, ...]:
    """Numbers in each of the large tables of a group; the last holds the outputs."""
    slots, n = group.family.modes * 2 * KINDS, group.places.states
    return *lifted_counts(n, group.watches, slots), len(group.family.rows) * slots * BLOCK * n


def _loaded(worker: SampledWorker, group: SampledGroup, room: Array) -> SampledWorker:
    """The worker with its large tables in a room, and the numbers of a group; none of its tables are filled yet."""
    worker.loaded[:] = -1
    family = group.family
    pending = worker.scratch.pending._replace(
        flows=family.flows,
        rows=family.guards,
        resets=family.resets,
        step=family.step,
        # The flow of a tick is made of fine and coarse jumps; blocks are those of ticks.
        reach=family.searches,
    )
    *tables, outputs = cut(room, _counts(group))
    lifted = lifted_in(tables, group.places.states, group.watches)
    return worker._replace(
        scratch=worker.scratch._replace(pending=pending),
        lifted=worker.lifted._replace(lifted=lifted),
        outputs=outputs.reshape(len(family.rows), -1),
    )


def _new_memory(group: SampledGroup) -> _Memory:
    family, n = group.family, group.places.states
    tables = empty_tables(group.loop.automaton, group.flow_of)
    *elsewhere, outputs = [np.empty(0)] * len(_counts(group))
    worker = SampledWorker(
        tables,
        memory_around(elsewhere, group.places, family.modes, group.watches),
        new_scratch(tables),
        np.zeros(n),
        Place(np.zeros(9, dtype=np.int64), np.zeros(1)),
        np.full(2, -1),
        np.zeros(4),
        np.zeros((len(family.rows), family.modes * 2 * KINDS), dtype=np.int8),
        outputs,
    )
    return _Memory(worker, new_segments(n, _ROOM), new_record(group.places.plant))
