"""The sampled loop (the deployed one): the edge's own tick, compiled, on the exact plant.

Contacts of the gap inside a sample are located.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotwin.control import law
from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.flow import new_scratch
from servotwin.hybrid.kernel import (
    CHANGES_AT_ONCE,
    EVENTS_PER_STEP,
    FULL,
    ZENO,
    follow_schedule,
    grown,
    new_record,
)
from servotwin.hybrid.tables import search_step
from servotwin.hybrid.trajectory import ON_GRID, Jump, ZenoError, schedule_of, tables_for
from servotwin.plant.automaton import degree, sampled_plant
from servotwin.plant.noise import Noise, NoiseSource
from servotwin.plant.plants import Plant
from servotwin.plant.sensors import Encoder
from servotwin.plant.signals import PiecewiseCubic
from servotwin.simulation.between_ticks import BetweenTicks
from servotwin.simulation.continuous import at_zero
from servotwin.simulation.inputs import RunInputs, quantised, steps_of
from servotwin.simulation.readings import TICKED_MOTOR, NoiseBuffer, PositionErrors, Readings, chunk_ends
from servotwin.simulation.start import plant_start, set_states, started
from servotwin.simulation.ticks import Port, TickInputs, new_output, run_ticks, shifted_output, tick_and_record

# Ticks of a chunk of noise, and chunks that are drawn before they are asked for.
_CHUNK, _DRAWN_AHEAD = 1 << 15, 3
_RECORDED = ("theta_m", "theta_d", "voltage")


@dataclass
class SampledEngine:
    """Engine of a `Simulation` whose controller has a sample rate; with `keep` it stores at least that many samples,
    and no events. A voltage is applied `delay` ticks after its measurement; zero until then."""

    servo: Plant
    controller: Controller
    inputs: RunInputs
    theta_d0: float
    samples: int
    noise: Noise | None
    rng: np.random.Generator
    keep: int | None = None
    delay: int = 0
    readings: Readings | None = None

    def __post_init__(self) -> None:
        assert self.controller.sample_rate is not None
        self.tick_every, self.record_every = steps_of(self.controller.sample_rate, self.inputs.sample_rate)
        self.rate = self.inputs.sample_rate * self.record_every
        constants = self.inputs.constants(self.servo)
        bias, friction = constants["input bias"] != 0.0, constants["friction"] != 0.0
        self.plant = sampled_plant(self.servo, degree(self.inputs.gap), bias, friction)
        step, searches = search_step(self.plant.automaton, 1.0 / self.rate)
        self.step, self.tables = step, tables_for(self.plant.automaton, step)
        start = plant_start(self.servo, self.plant, float(self.inputs.gap.value(0.0)), self.theta_d0)
        self.state = start.state
        for index, value in self.plant.input_values("gap", at_zero(self.inputs.gap)).items():
            self.state[index] = value
        set_states(self.plant, self.state, constants)
        self.mode, self.base, self.finished = self.plant.mode("held", start.side), 0, False
        self.record = new_record(len(self.state), EVENTS_PER_STEP + 8, 4 * EVENTS_PER_STEP)
        self.scratch = new_scratch(self.tables)
        self.law_state, self.parameters = self._started(start.command)
        self.draws = NoiseBuffer(self._noise_source(), ahead=0 if self.keep is None else _CHUNK)
        self.between = self._between_ticks()
        self.port = self._make_port(searches)
        samples = self.samples if self.keep is None else 2 * self.keep + 1 + self.tick_every
        between = self.readings is not None and self.readings.between_samples
        self.output = new_output(len(self.port.recorded), samples, self.tick_every, self.record_every, between)

    def _started(self, command: float) -> tuple[Any, Any]:
        """State of the law at rest under a command that holds the load, and its parameters, of the kind that this
        engine's ticks take."""
        measured = float(self.plant.rows["sensed"][0] @ self.state) + self._encoder_error()
        return started(self.controller, measured, command), self.controller.law(None)

    @property
    def _applied(self) -> float:
        """Command before the first tick."""
        return float(self.law_state.voltage)

    def _make_port(self, searches: int) -> Port:
        names = self.plant.automaton.names
        return Port(
            names.index("voltage"),
            int(np.argmax(self.plant.rows["sensed"][0])),
            names.index("theta_m"),
            self.servo.position_resolution,
            1 if self.servo.position_resolution > 0.0 else 0,
            np.array(self._recorded()),
            self.tick_every,
            self.record_every,
            searches,
            len(self.record.event_step) - EVENTS_PER_STEP - CHANGES_AT_ONCE,
            np.full(self.delay, self._applied),
            np.full(self._fed_back.late(self.tick_rate), self._reading(self._encoder_error())),
        )

    def _noise_source(self) -> NoiseSource | PositionErrors | None:
        """Source of what the measured position is off by at each tick."""
        if self.readings is not None:
            return self.readings.source(self.tick_rate, self.tick_every, self.rng)
        return None if self.noise is None else self.noise.source(self.tick_rate, self.rng)

    def _between_ticks(self) -> BetweenTicks:
        noise = None
        if self.noise is not None and self.tick_every > 1:
            noise = self.noise.source(self.rate, self.rng.spawn(1)[0])
        return BetweenTicks(self._fed_back.late(self.rate), self.servo.position_resolution, self.readings, noise)

    @property
    def _fed_back(self) -> Encoder:
        """Encoder of the measured position."""
        return self.servo.sensors.fed_back(self.servo.p)

    def _recorded(self) -> list[int]:
        """States that are written at every sample."""
        names = self.plant.automaton.names
        chain = [i for i, name in enumerate(names) if name.startswith("chain")]
        return [names.index(name) for name in _RECORDED] + chain[: len(chain) // 2]

    @property
    def index(self) -> int:
        """Sample reached."""
        return self.base // self.record_every

    @property
    def oldest(self) -> int:
        """The oldest stored sample."""
        return self.output.first_sample

    def advance(self, index: int) -> None:
        """Advance to a sample; at the last one of the horizon the tick is taken too."""
        while self.keep is not None and index - self.index > self.keep:
            self._advance(self.index + self.keep)
        self._advance(index)

    def _advance(self, index: int) -> None:
        end = index * self.record_every
        self.make_room(index)
        for base, jumps in self.knots(end):
            self._run(base)
            self._run_through(base, jumps)
        self._run(end)
        if index == self.samples - 1:
            self._tick_and_record(self.base)
            self.finished = True

    def make_room(self, index: int) -> None:
        """Drop the oldest samples if samples up to `index` would not fit."""
        if self.keep is not None and index - self.oldest > 2 * self.keep:
            self.output = shifted_output(self.output, self.index - self.keep, self.tick_every, self.record_every)
            self.record.size[1] = 0
            self.between.forget(self.oldest)

    def knots(self, end: int) -> list[tuple[int, list[Jump]]]:
        """Base steps during or at the end of which the gap's cubic changes, with those changes."""
        changes = dict[int, list[Jump]]()
        # A knot on a base step belongs to the step that ends there; rounding must not move it to the next one.
        bases = np.ceil(self.inputs.gap.times * self.rate - 1e-9).astype(np.int64) - 1
        for piece in np.flatnonzero((self.base <= bases) & (bases < end)).tolist():
            time, coefficients = float(self.inputs.gap.times[piece]), self.inputs.gap.coeffs[piece]
            opened = self.plant.opened if time in self.inputs.gap.jumps else None
            jump = Jump(time, self.plant.input_values("gap", coefficients), opened)
            changes.setdefault(int(bases[piece]), []).append(jump)
        return sorted(changes.items())

    def tick_inputs(self, first: int, last: int) -> TickInputs:
        """Inputs of ticks first .. last - 1."""
        count = max(last - first, 0)
        enter, leave = self._thresholds(first, count)
        reference, noise = self._on_ticks(self.inputs.reference, first, count), self.draws.take(count)
        motor = self._motor_errors(first, count)
        masks = (0 if each.size == 1 else -1 for each in (reference, noise, enter, motor))
        return TickInputs(first, reference, noise, enter, leave, motor, *masks)

    def _motor_errors(self, _first: int, _count: int) -> Array:
        """Errors (rad) of the motor's encoder at ticks, which this law does not read."""
        return np.zeros(1)

    def _on_ticks(self, signal: PiecewiseCubic, first: int, count: int) -> Array:
        """Values at ticks; one value where it is constant."""
        constant = signal.constant_between(first / self.tick_rate, (first + count - 1) / self.tick_rate)
        return (
            np.array([constant])
            if constant is not None
            else signal.on(np.arange(first, first + count) / self.tick_rate)
        )

    def _thresholds(self, first: int, count: int) -> tuple[Array, Array]:
        """Thresholds of the dead zone at ticks; one pair where they are constant."""
        if self.inputs.tolerance is None:
            return np.array([-1.0]), np.array([-1.0])
        tolerance = self._on_ticks(self.inputs.tolerance, first, count)
        # No dead zone: thresholds of zero would cut the voltage whenever a quantised error is zero.
        zero = tolerance == 0.0
        enter = np.where(zero, -1.0, self.controller.enter * tolerance)
        return enter, np.where(zero, -1.0, self.controller.leave * tolerance)

    def _run(self, end: int) -> None:
        if self.noise is None or end - self.base <= _CHUNK:
            while self.base < end:
                stop = min(end, self.base + _CHUNK)
                self.flow(stop, self._inputs_until(self.base, stop))
            return
        # The noise of the next chunks is drawn while this one runs. The first one, which is waited for, is short, and
        # they grow slowly, so that no later one is waited for.
        ends = chunk_ends(self.base, end)
        chunks = deque(zip([self.base, *ends], ends, strict=False))
        with ThreadPoolExecutor(1) as pool:
            coming = deque(pool.submit(self._inputs_until, *chunks.popleft()) for _ in ends[:_DRAWN_AHEAD])
            for stop in ends:
                tick_inputs = coming.popleft().result()
                if chunks:
                    coming.append(pool.submit(self._inputs_until, *chunks.popleft()))
                self.flow(stop, tick_inputs)

    def _inputs_until(self, base: int, end: int) -> TickInputs:
        """Inputs of the ticks from one base step up to another."""
        return self.tick_inputs(-(-base // self.tick_every), -(-end // self.tick_every))

    def flow(self, end: int, tick_inputs: TickInputs) -> None:
        """Advance to a base step; `tick_inputs` covers the ticks on the way, while the gap's cubic stays the same."""
        while self.base < end:
            status, self.base, self.mode, self.law_state = run_ticks(
                self.tables,
                self.state,
                self.base,
                end,
                self.mode,
                self.parameters,
                self.law_state,
                self.port,
                tick_inputs,
                self.output,
                self.record,
                self.scratch,
            )
            self._check(status)

    def _run_through(self, base: int, jumps: list[Jump]) -> None:
        """One base step in which the gap's cubic changes."""
        self._tick_and_record(base)
        at = np.array([base * self.port.searches, self.mode, 0, 0], dtype=np.int64)
        end = (base + 1) * self.port.searches
        steps, fractions, values, modes = schedule_of(jumps, self.step, self.plant.automaton, end)
        place, status = np.zeros(1), FULL
        # A full record is enlarged, and the same schedule goes on where it stopped.
        while status == FULL:
            status = follow_schedule(
                self.tables, self.state, place, at, steps, fractions, values, modes, self.record, self.scratch
            )
            # Segments are not needed: the samples are written as the plant flows.
            self.record.size[0] = 0
            self._check(status)
        self.mode, self.base = int(at[1]), base + 1

    def _tick_and_record(self, base: int) -> None:
        """Tick and record where they are due at a base step, without the flow after it."""
        tick_inputs = self.tick_inputs(-(-base // self.tick_every), base // self.tick_every + 1)
        self.law_state = tick_and_record(
            base, self.state, self.parameters, self.law_state, self.port, tick_inputs, self.output
        )

    def _check(self, status: int) -> None:
        if status == ZENO:
            raise ZenoError(f"the plant changes mode without end at t = {self.base / self.rate:.9g} s")
        if status == FULL:
            self.record = grown(self.record)
            room = len(self.record.event_step) - EVENTS_PER_STEP - CHANGES_AT_ONCE
            self.port = self.port._replace(room=room)

    def set_tolerance(self, _tolerance: float) -> None:
        """Do nothing: the ticks to come read the inputs."""

    def set_reference(self, _reference: PiecewiseCubic) -> None:
        """Do nothing: the ticks to come read the inputs."""

    def set_controller(self, controller: Controller, tolerance: float | None) -> None:
        """Change the controller from the tick that is due on, without a jump of its voltage; a constant tolerance
        unless None."""
        tick = -(-self.base // self.tick_every)
        time = tick / self.tick_rate
        planned = None if self.inputs.tolerance is None else float(self.inputs.tolerance.value(time))
        self.law_state = law.transfer(
            self.controller.law(planned),
            controller.law(planned if tolerance is None else tolerance),
            self.law_state,
            float(self.inputs.reference.value(time)),
            self._shown(self._noise_ahead()),
        )
        self.controller, self.parameters = controller, controller.law(None)

    def channel(self, name: str, first: int, last: int) -> Array:
        """A channel at samples first .. last - 1; at the present one, before its tick, the voltage is still the
        last."""
        if name == "measured_position":
            return self._measured(first, last)
        if name == TICKED_MOTOR:
            return self.output.motor[first - self.output.first_tick : last - self.output.first_tick]
        row = self.plant.rows[name][0]
        out = np.zeros(last - first)
        for j, state in enumerate(self.port.recorded):
            if row[state] != 0.0:
                out += row[state] * self.output.states[j, first - self.oldest : last - self.oldest]
        if last > self.index and not self.finished:
            out[-1] = row @ self.state
        return out

    def _measured(self, first: int, last: int) -> Array:
        samples = np.arange(first, last)
        ticks, since = np.divmod(samples * self.record_every, self.tick_every)
        out = self.output.measured[ticks - self.output.first_tick]
        between = since > 0
        if np.any(between):
            out[between] = self.between.read(samples[between], self._sensed)
        if last > self.index and not self.finished and not between[-1]:
            out[-1] = self._measured_now()
        return out

    def _sensed(self, first: int, last: int) -> Array:
        """Position (m) that the sensor sees at samples first .. last - 1, without errors and delay."""
        if self.servo.at_motor:
            return self.servo.p * self.channel("theta_m", first, last)
        return self.channel("position", first, last)

    def _measured_now(self) -> float:
        """Measurement of the present state, without a noise that is still to be drawn."""
        return self._shown(self._encoder_error())

    def _encoder_error(self) -> float:
        """Error of the encoder of the position in the present state."""
        return 0.0 if self.readings is None else float(np.ravel(self.readings.position.at(np.array([self.base])))[0])

    def _noise_ahead(self) -> float:
        """Noise of the tick that is due, which takes it again."""
        noise = self.draws.take(1)
        self.draws.put_back(noise)
        return float(noise[0])

    def _reading(self, noise: float = 0.0) -> float:
        """Reading of the position sensor in the present state."""
        present = np.array(self.plant.rows["sensed"][0] @ self.state + noise)
        return float(quantised(present, self.servo.position_resolution))

    def _shown(self, noise: float = 0.0) -> float:
        """Reading that the tick that is due gets: of a late sensor that of some ticks ago."""
        late = self.port.late
        return float(late[-(-self.base // self.tick_every) % late.size]) if late.size else self._reading(noise)

    def events(self) -> list[tuple[float, str, int, bool]]:
        """Events of the plant and of the ticks, in time order."""
        r, size = self.record, int(self.record.size[1])
        times = (r.event_step[:size] + r.event_fraction[:size]) * self.step
        modes = self.plant.automaton.modes
        events = []
        for k in range(size):
            guard = modes[r.event_mode[k]].guards[r.event_guard[k]]
            events.append((float(times[k]), guard.label, guard.side, not r.event_forced[k]))
        return sorted(events + self._tick_events(), key=lambda event: event[0])

    def _tick_events(self) -> list[tuple[float, str, int, bool]]:
        """Dead-zone events, at the ticks that decided them; forced where the reference jumped since the tick before."""
        count = (self.base - 1) // self.tick_every + 1 + (1 if self.finished else 0) if self.base else 0
        count = min(count, len(self.output.active))
        active, times = self.output.active[:count], np.arange(count) / self.tick_rate
        changed = np.flatnonzero(np.diff(active, prepend=active[:1]))
        jumps = self.inputs.reference.jumps
        error = self.inputs.reference.value(times[changed]) - self.output.measured[changed]
        events = []
        for k, e in zip(changed.tolist(), error.tolist(), strict=True):
            ticks_ago = (times[k] - jumps) * self.tick_rate
            forced = bool(np.any((ticks_ago > -ON_GRID) & (ticks_ago < 1.0 - ON_GRID)))
            events.append((float(times[k]), "leave" if active[k] else "enter", 1 if e > 0 else -1, not forced))
        return events

    @property
    def tick_rate(self) -> float:
        """Ticks per second."""
        assert self.controller.sample_rate is not None
        return self.controller.sample_rate
