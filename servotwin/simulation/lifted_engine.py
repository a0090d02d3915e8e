"""Engine of a sampled run without noise and quantisation: blocks of ticks, recorded as their starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.flow import new_scratch
from servotwin.hybrid.kernel import (
    DONE,
    FULL,
    ZENO,
    follow_schedule,
    grown,
    new_record,
)
from servotwin.hybrid.lifted import BLOCK, COARSE, lifted_counts, lifted_in, new_lifted_workspace, row_count
from servotwin.hybrid.tables import search_step, zeros
from servotwin.hybrid.trajectory import ON_GRID, Jump, ZenoError, schedule_of, tables_for
from servotwin.plant.automaton import ServoAutomaton, degree, sampled_plant
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.simulation.continuous import at_zero
from servotwin.simulation.inputs import RunInputs
from servotwin.simulation.lifted import (
    TICKED,
    UNFILLED,
    latest_direction,
    more_segments,
    new_segments,
    run_lifted,
    set_reference,
    take_tick,
)
from servotwin.simulation.lifted_output import sample_lifted
from servotwin.simulation.lifted_tables import KINDS, LiftedLoop, LiftedMemory, Place, Places, fill_here
from servotwin.simulation.start import plant_start, set_states, started

# Room of a record: the system provides the memory that is used.
_ROOM = 1 << 14
# Ticks, of a run and per piece of the inputs, below which blocks do not pay.
_TICKS_PER_RUN, _TICKS_PER_PIECE = 20_000, 64


def advances_in_blocks(servo: Plant, controller: Controller, inputs: RunInputs, samples: int) -> bool:
    """True for a noise-free run that `LiftedEngine` can do: a sampled law, an ideal sensor, ticks at every sample, and
    many ticks, inputs of few pieces with a tolerance that is constant in each; a friction feedforward needs such a
    reference."""
    if controller.sample_rate is None or servo.position_resolution != 0.0 or servo.sensors.fed_back(servo.p).delay:
        return False
    if controller.friction_feedforward != 0.0 and degree(inputs.reference) > 0:
        return False
    ratio = controller.sample_rate / inputs.sample_rate
    if round(ratio) < 1 or abs(ratio - round(ratio)) > ON_GRID * ratio:
        return False
    if inputs.tolerance is not None and bool(np.any(inputs.tolerance.coeffs[:, 1:] != 0.0)):
        return False
    signals = [inputs.reference, inputs.gap, *([] if inputs.tolerance is None else [inputs.tolerance])]
    pieces = sum(signal.times.size - 1 for signal in signals)
    return (samples - 1) * round(ratio) >= max(pieces * _TICKS_PER_PIECE, _TICKS_PER_RUN)


def places_of(
    plant: ServoAutomaton, controller: Controller, delay: int, reference_degree: int, counts: bool = False
) -> Places:
    """Indices of the plant's, the law's and the inputs' states; `counts`: of a position sensor with a resolution.

    Spare states of the plant, which nothing moves and nothing reads, hold the law's first ones: with the paper's servo
    there are 16 then instead of 20, and products take a third of the time less.
    """
    names = plant.automaton.names
    spare = [k for k, name in enumerate(names) if name.startswith("spare")]
    count, places = len(names), dict[str, int]()
    for name, exists in (
        ("integral", True),
        ("derivative", True),
        ("filtered", controller.loop_filter_hz is not None),
        ("rate", controller.rate_limit is not None),
        ("feedforward", controller.feedforward != 0.0 or controller.friction_feedforward != 0.0),
        ("past", controller.velocity_feedforward != 0.0),
        ("ahead", controller.velocity_feedforward != 0.0),
        ("notch", controller.notch_hz != 0.0),
        ("notch_low", controller.notch_hz != 0.0),
        ("counted", counts),
    ):
        places[name] = -1
        if exists and spare:
            places[name] = spare.pop(0)
        elif exists:
            places[name], count = count, count + 1
    waiting, reference = (count if delay else -1), count + delay
    states = reference + reference_degree + 1
    return Places(
        len(names),
        states + (-states % 4),
        names.index("voltage"),
        int(np.argmax(plant.rows["sensed"][0])),
        **places,
        waiting=waiting,
        delay=delay,
        reference=reference,
        degree=reference_degree,
    )


def start_law(state: Array, places: Places, law: Controller, command: float) -> None:
    """Set the law's states of a run that begins with a command that holds the load."""
    law_state = started(law, float(state[places.position]), command)
    state[places.integral] = law_state.integral
    waiting = range(places.waiting, places.waiting + places.delay) if places.delay else ()
    for place in (places.voltage, places.rate, *waiting):
        if place >= 0:
            state[place] = law_state.voltage


def watches_of(plant: ServoAutomaton, controller: Controller, dead_zone: bool, counts: bool = False) -> int:
    """Largest number of quantities that a block must bound."""
    guards = max(len(mode.guards) for mode in plant.automaton.modes)
    limits = (controller.voltage_limit is not None) + 2 * (controller.rate_limit is not None)
    return guards + dead_zone + limits + counts


def new_memory(places: Places, modes: int, watches: int) -> LiftedMemory:
    """Tables and working memory of one run."""
    tables = [zeros(count) for count in lifted_counts(places.states, watches, modes * 2 * KINDS)]
    return memory_around(tables, places, modes, watches)


def memory_around(tables: Sequence[Array], places: Places, modes: int, watches: int) -> LiftedMemory:
    """Working memory around tables of `lifted_counts`."""
    n, slots = places.states, modes * 2 * KINDS
    rows = max(row_count(n, watches, COARSE), COARSE * n)
    return LiftedMemory(
        lifted_in(tables, n, watches),
        new_lifted_workspace(n, watches),
        np.zeros(slots, dtype=np.int8),
        np.zeros(slots, dtype=np.int8),
        np.zeros(slots * n),
        np.zeros(watches),
        np.zeros(watches),
        np.zeros(watches),
        np.zeros(watches),
        np.zeros(rows),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n * n),
        np.zeros(places.plant**2),
    )


@dataclass
class LiftedEngine:
    """A sampled run from rest to its end, for which `advances_in_blocks` holds."""

    servo: Plant
    controller: Controller
    inputs: RunInputs
    theta_d0: float
    samples: int
    delay: int = 0
    index: int = field(default=0, init=False)
    tolerance: float | None = field(default=None, init=False)
    """m, whose thresholds the loop has."""

    def __post_init__(self) -> None:
        rate = self.controller.sample_rate
        assert rate is not None
        self.rate, self.every = rate, round(rate / self.inputs.sample_rate)
        constants = self.inputs.constants(self.servo)
        bias, friction = constants["input bias"] != 0.0, constants["friction"] != 0.0
        self.plant = sampled_plant(self.servo, degree(self.inputs.gap), bias, friction)
        self.step, searches = search_step(self.plant.automaton, 1.0 / rate)
        self.tables = tables_for(self.plant.automaton, self.step)
        resolution = self.servo.position_resolution
        counts = resolution > 0.0
        self.places = places_of(self.plant, self.controller, self.delay, degree(self.inputs.reference), counts)
        start, command, side = plant_start(self.servo, self.plant, float(self.inputs.gap.value(0.0)), self.theta_d0)
        for index, value in self.plant.input_values("gap", at_zero(self.inputs.gap)).items():
            start[index] = value
        set_states(self.plant, start, constants)
        self.state = np.zeros(self.places.states)
        self.state[: self.places.plant] = start
        for follower in (self.places.filtered, self.places.past, self.places.counted):
            if follower >= 0:
                self.state[follower] = start[self.places.position]
        if self.places.feedforward >= 0:
            self.state[self.places.feedforward] = self.controller.feedforward
        start_law(self.state, self.places, self.controller, command)
        self.past, self.direction = float(start[self.places.position]), 0.0
        modes, law = len(self.plant.automaton.modes), self.controller.law(None)
        dead_zone = self.inputs.tolerance is not None and bool(np.any(self.inputs.tolerance.coeffs[:, 0] > 0.0))
        self.loop = LiftedLoop(
            law, dead_zone, searches, self.step, self.plant.automaton.flows.ravel(), modes, resolution
        )
        self.memory = new_memory(self.places, modes, watches_of(self.plant, self.controller, dead_zone, counts))
        self.segments = new_segments(self.places.states, _ROOM)
        self.record = new_record(self.places.plant)
        self.scratch = new_scratch(self.tables)
        mode = self.plant.mode("held", side)
        self.place = Place(np.array([0, mode, 1, 0, 0, 0, 0, 0, 0], dtype=np.int64), np.zeros(1))

    def advance(self, index: int) -> None:
        """Run from the start to the last sample; `index` must be that one."""
        assert self.index == 0
        assert index == self.samples - 1
        end = index * self.every
        jumps = self._gap_jumps(end)
        stops = np.unique(np.concatenate([self._knots(end), [*jumps], [tick + 1 for tick in jumps], [end]]))
        for stop in stops.astype(np.int64).tolist():
            if stop - 1 in jumps:
                self._run_through(jumps[stop - 1])
            else:
                self._run(stop)
        self._take_tick()
        self.index = index

    def _knots(self, end: int) -> NDArray[np.int64]:
        """Ticks from which on another piece of the reference or of the tolerance is in force."""
        signals = [self.inputs.reference, *([] if self.inputs.tolerance is None else [self.inputs.tolerance])]
        times = np.concatenate([signal.times for signal in signals])
        ticks = np.ceil(times * self.rate - ON_GRID).astype(np.int64)
        return ticks[(ticks > 0) & (ticks < end)]

    def _gap_jumps(self, end: int) -> dict[int, list[Jump]]:
        """Ticks after which, before the next one or at it, the gap's cubic changes, with those changes."""
        gap, changes = self.inputs.gap, dict[int, list[Jump]]()
        ticks = np.ceil(gap.times * self.rate - ON_GRID).astype(np.int64) - 1
        for piece in np.flatnonzero((ticks >= 0) & (ticks < end)).tolist():
            time = float(gap.times[piece])
            opened = self.plant.opened if time in gap.jumps else None
            jump = Jump(time, self.plant.input_values("gap", gap.coeffs[piece]), opened)
            changes.setdefault(int(ticks[piece]), []).append(jump)
        return changes

    def _now(self) -> tuple[Array, float]:
        """Coefficients of the reference's cubic in force, and the time at which it begins; sets the thresholds."""
        time = self.place.at[0] / self.rate
        piece = _piece(self.inputs.reference, time, self.rate)
        if self.inputs.tolerance is not None:
            tolerance = float(self.inputs.tolerance.coeffs[_piece(self.inputs.tolerance, time, self.rate), 0])
            if tolerance != self.tolerance:
                self.tolerance, self.loop = tolerance, self.loop._replace(parameters=self.controller.law(tolerance))
        # A copy: a read-only array is a type of its own to numba, for which all would be compiled once more.
        coefficients = self.inputs.reference.coeffs[piece].copy()
        if (friction := self.controller.friction_feedforward) != 0.0:
            # The reference is constant in every piece.
            self.direction = latest_direction(float(coefficients[0]) - self.past, self.direction)
            self.past = float(coefficients[0])
            self.state[self.places.feedforward] = self.controller.feedforward + friction * self.direction
        return coefficients, float(self.inputs.reference.times[piece])

    def _run(self, end: int) -> None:
        coefficients, origin = self._now()
        status = FULL
        while status != DONE:
            status = run_lifted(
                self.tables,
                self.loop,
                self.places,
                coefficients,
                origin,
                self.rate,
                self.state,
                self.place,
                end,
                self.segments,
                self.record,
                self.scratch,
                self.memory,
            )
            if status == UNFILLED:
                fill_here(self.tables, self.loop, self.places, self.place, self.memory)
            self._grow(status)

    def _grow(self, status: int) -> None:
        if status == ZENO:
            raise ZenoError(f"the plant changes mode without end at t = {self.place.at[0] / self.rate:.9g} s")
        if status == FULL:
            if self.record.size[1] > len(self.record.event_step) // 2:
                self.record = grown(self.record)
            if 2 * max(self.segments.size) > len(self.segments.tick):
                self.segments = more_segments(self.segments)

    def _take_tick(self) -> None:
        """One tick, without the flow after it."""
        coefficients, origin = self._now()
        tick, active = int(self.place.at[0]), self.place.at[2]
        set_reference(self.places, coefficients, tick / self.rate - origin, self.state)
        error = take_tick(self.loop, self.places, self.state, self.place)
        if 2 + max(self.segments.size) > len(self.segments.tick):
            self.segments = more_segments(self.segments)
        if self.place.at[2] != active and tick > 0:
            at = self.segments.size[1]
            self.segments.change_tick[at], self.segments.change_error[at] = tick, error
            self.segments.change_active[at] = self.place.at[2] == 1
            self.segments.size[1] += 1
        at = self.segments.size[0]
        self.segments.tick[at], self.segments.slot[at], self.segments.state[at] = tick, TICKED, self.state
        self.segments.size[0] += 1

    def _run_through(self, jumps: list[Jump]) -> None:
        """One tick after which the gap's cubic changes."""
        self._take_tick()
        tick, searches = int(self.place.at[0]), self.loop.searches
        at = np.array([tick * searches, self.place.at[1], 0, 0], dtype=np.int64)
        steps, fractions, values, modes = schedule_of(jumps, self.step, self.plant.automaton, (tick + 1) * searches)
        place, status = np.zeros(1), FULL
        while status == FULL:
            status = follow_schedule(
                self.tables,
                self.state[: self.places.plant],
                place,
                at,
                steps,
                fractions,
                values,
                modes,
                self.record,
                self.scratch,
            )
            self.record.size[0] = 0
            if status == FULL:
                self.record = grown(self.record)
            elif status == ZENO:
                self._grow(ZENO)
        self.place.at[0], self.place.at[1], self.place.at[5] = tick + 1, at[1], 0

    def channel(self, name: str, first: int, last: int) -> Array:
        """A channel at samples first .. last - 1, of all samples."""
        row = np.zeros(self.places.states)
        if name == "measured_position" and self.places.counted >= 0:
            row[self.places.counted] = 1.0
            return self.sampled(row)[first:last]
        row[: self.places.plant] = self.plant.rows["position" if name == "measured_position" else name][0]
        return self.sampled(row)[first:last]

    def sampled(self, row: Array) -> Array:
        """``row @ state`` after the tick, at every sample."""
        slots, n = len(self.memory.filled), self.places.states
        out, table = np.empty((1, self.samples)), np.empty((1, slots * BLOCK * n))
        filled, end = np.zeros((1, slots), dtype=np.int8), (self.samples - 1) * self.every + 1
        sample_lifted(self.segments, self.memory, self.places, row[None], end, self.every, filled, table, out)
        return out[0]

    def events(self) -> list[tuple[float, str, int, bool]]:
        """Events of the plant and of the ticks, in time order."""
        r, size = self.record, int(self.record.size[1])
        times = (r.event_step[:size] + r.event_fraction[:size]) * self.step
        modes, events = self.plant.automaton.modes, []
        for k in range(size):
            guard = modes[r.event_mode[k]].guards[r.event_guard[k]]
            events.append((float(times[k]), guard.label, guard.side, not r.event_forced[k]))
        s, jumps = self.segments, self.inputs.reference.jumps
        for k in range(int(s.size[1])):
            ticks_ago = s.change_tick[k] - jumps * self.rate
            forced = bool(np.any((ticks_ago > -ON_GRID) & (ticks_ago < 1.0 - ON_GRID)))
            label = "leave" if s.change_active[k] else "enter"
            events.append((s.change_tick[k] / self.rate, label, 1 if s.change_error[k] > 0.0 else -1, not forced))
        return sorted(events, key=lambda event: event[0])


def _piece(signal: PiecewiseCubic, time: float, rate: float) -> int:
    """The piece in force at the tick of a time."""
    return max(int(np.searchsorted(signal.times * rate, time * rate + ON_GRID, side="right")) - 1, 0)
