"""The continuous loop (the paper's): plant and law as one automaton, exact between located events."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.law import replaced
from servotwin.control.laws import Law
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import ON_GRID, Jump, Trajectory
from servotwin.plant.automaton import INPUTS, ServoAutomaton, Shape, continuous_loop, degree
from servotwin.plant.linear_zones import law_state, linear_loop
from servotwin.plant.noise import NoiseSource
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.plant.turns import direction_after, turns_of
from servotwin.simulation.inputs import RunInputs, about, quantised
from servotwin.simulation.readings import PositionErrors
from servotwin.simulation.start import holding_integral, holding_states, plant_start, set_states

_NOISE_BLOCK = 4096


@dataclass
class ContinuousEngine:
    """Engine of a `Simulation` whose controller has no sample rate; noise is constant between samples."""

    servo: Plant
    controller: Law
    inputs: RunInputs
    theta_d0: float = 0.0
    refine: int = 1
    noise: NoiseSource | PositionErrors | None = None

    def __post_init__(self) -> None:
        _refuse_rate_limit(self.controller)
        signals = {name: self._signal(name) for name in INPUTS}
        self.past: list[tuple[ServoAutomaton, Trajectory]] = []
        self.loop = self._automaton(self.controller)
        start = plant_start(self.servo, self.loop, float(signals["gap"].value(0.0)), self.theta_d0)
        state = start.state
        for name, pieces in signals.items():
            for index, value in self.loop.input_values(name, at_zero(pieces)).items():
                state[index] = value
        constants = self.inputs.constants(self.servo)
        set_states(self.loop, state, constants | controller_constants(self.controller))
        if self.noise is not None:
            set_states(self.loop, state, {"noise": self.noise.block(1)[0]})
        followers = ("filtered", "lagging")
        position = float(self.loop.rows["measured_position"][0] @ state)
        set_states(self.loop, state, dict.fromkeys(followers, position))
        if isinstance(self.controller, LinearLaw):
            resting = law_at_rest(self.controller, LoopState(self.loop, state, 0), {}, start.command)
            set_states(self.loop, state, resting)
        else:
            set_states(self.loop, state, {"integral": holding_integral(self.controller, start.command)})
        self.direction = direction_after(signals["reference"], 0.0, position, 0.0)
        set_states(self.loop, state, {"friction feedforward": friction_feedforward(self.controller) * self.direction})
        enter = self.controller.enter * float(signals["tolerance"].value(0.0))
        error = float(self.loop.rows["error"][0] @ state)
        mode = self.loop.mode("on" if self.inputs.tolerance is None else start_zone(error, enter), start.side)
        self.trajectory = Trajectory(self.loop.automaton, state, mode, 1.0 / self.inputs.sample_rate, self.refine)

    def _automaton(self, controller: Law, offset: bool = False) -> ServoAutomaton:
        reference, gap, tolerance = (degree(self._signal(name)) for name in INPUTS)
        shape = Shape(
            reference,
            gap,
            tolerance,
            dead_zone=self.inputs.tolerance is not None,
            noise=self.noise is not None,
            bias=self.inputs.input_bias != 0.0,
            friction=self.inputs.friction + self.servo.motor_friction != 0.0,
            feedforward=controller.feedforward != 0.0,
            offset=offset,
            friction_feedforward=friction_feedforward(controller) != 0.0,
        )
        if isinstance(controller, LinearLaw):
            return linear_loop(self.servo, controller, shape)
        return continuous_loop(self.servo, controller, shape)

    def _signal(self, name: str) -> PiecewiseCubic:
        pieces: PiecewiseCubic | None = getattr(self.inputs, name)
        return PiecewiseCubic.constant(0.0) if pieces is None else pieces

    @property
    def state(self) -> Array:
        """States of plant and law at the sample reached."""
        return self.trajectory.state

    @property
    def index(self) -> int:
        """Sample reached."""
        return self.trajectory.samples - 1

    def advance(self, index: int) -> None:
        """Advance to a sample through the knots of the inputs."""
        # Every noise sample is a jump of its own: blocks bound the memory of their schedule.
        while self.noise is not None and index - self.index > _NOISE_BLOCK:
            self._advance(self.index + _NOISE_BLOCK)
        self._advance(index)

    def _advance(self, index: int) -> None:
        end = index / self.inputs.sample_rate
        # A knot that rounding puts behind the sample it belongs to is taken on it, in this call and not in the next.
        span = (self.index + ON_GRID, index + ON_GRID)
        knots: dict[float, dict[int, float]] = {}
        opening: set[float] = set()
        for name in INPUTS:
            pieces = self._signal(name)
            inside = slice(*np.searchsorted(pieces.times * self.inputs.sample_rate, span, side="right"))
            for time, coefficients in zip(pieces.times[inside].tolist(), pieces.coeffs[inside], strict=True):
                knots.setdefault(time, {}).update(self.loop.input_values(name, coefficients))
            if name == "gap":
                opening = {float(time) for time in pieces.jumps}
        for time, direction in self._turns(span):
            self.direction = direction
            knots.setdefault(time, {})[self.loop.automaton.index("friction feedforward")] = (
                friction_feedforward(self.controller) * direction
            )
        if self.noise is not None:
            times = self.inputs.times(self.index + 1, index + 1).tolist()
            for time, value in zip(times, self.noise.block(len(times)).tolist(), strict=True):
                knots.setdefault(time, {})[self.loop.automaton.index("noise")] = value
        # One jump per time: inputs that change together must not be followed by guards in between.
        jumps = [Jump(min(t, end), knots[t], self.loop.opened if t in opening else None) for t in sorted(knots)]
        self.trajectory.advance(index, jumps)

    def _turns(self, span: tuple[float, float]) -> list[tuple[float, float]]:
        """Times (s) within a span of samples at which the reference may change its direction, and that then."""
        if friction_feedforward(self.controller) == 0.0:
            return []
        turns = turns_of(self.inputs.reference)
        times = np.array([time for time, _ in turns]) * self.inputs.sample_rate
        return turns[slice(*np.searchsorted(times, span, side="right"))]

    def set_tolerance(self, tolerance: float) -> None:
        """Set a constant tolerance from now on."""
        self.trajectory.set(self.loop.input_values("tolerance", np.array([tolerance, 0.0, 0.0, 0.0])))

    def set_reference(self, reference: PiecewiseCubic) -> None:
        """Follow another reference from now on, already part of the inputs; a higher degree needs another automaton."""
        time = self.index / self.inputs.sample_rate
        now = about(reference, time)
        before = float(self.trajectory.state[self.loop.automaton.index("reference")])
        if len(self.loop.input_values("reference", now)) <= degree(reference):
            self.set_controller(self.controller, None)
        self.direction = direction_after(reference, time, before, self.direction)
        values = self.loop.input_values("reference", now)
        if friction_feedforward(self.controller) != 0.0:
            values[self.loop.automaton.index("friction feedforward")] = (
                friction_feedforward(self.controller) * self.direction
            )
        self.trajectory.set(values)

    def set_controller(self, controller: Law, tolerance: float | None) -> None:
        """Change the controller from now on without a jump of the voltage; a constant tolerance unless None."""
        _refuse_rate_limit(controller)
        values = controller_constants(controller) | {
            "friction feedforward": friction_feedforward(controller) * self.direction
        }
        if tolerance is not None:
            names = [name for name in self.loop.automaton.names if name.startswith("tolerance")]
            values |= dict.fromkeys(names, 0.0) | {"tolerance": tolerance}
        now, index = LoopState(self.loop, self.trajectory.state, self.trajectory.mode), self.index
        place = change_controller(now, controller, values, lambda offset: self._automaton(controller, offset))
        # Another controller is another automaton: samples before it are read from the old trajectory.
        self.past.append((self.loop, self.trajectory))
        self.controller, self.loop = controller, place.loop
        step = 1.0 / self.inputs.sample_rate
        self.trajectory = Trajectory(place.loop.automaton, place.state, place.mode, step, self.refine, index)
        # Guards that the change made positive are followed now, so that the present sample shows the new zone.
        self.trajectory.advance(index)

    def channel(self, name: str, first: int, last: int) -> Array:
        """A channel at samples first .. last - 1."""
        pieces = [*self.past, (self.loop, self.trajectory)]
        ends = [trajectory.first for _, trajectory in pieces[1:]] + [last]
        parts = []
        for (loop, trajectory), end in zip(pieces, ends, strict=True):
            begin, end = max(first, trajectory.first), min(end, last)
            if begin < end:
                parts.append(trajectory.sampled(loop.rows[name], begin, end))
        # One part is not copied: that would take as long as to write it.
        values = parts[0] if len(parts) == 1 else np.concatenate([*parts, np.empty(0)])
        return quantised(values, self.servo.position_resolution) if name == "measured_position" else values

    def events(self) -> list[tuple[float, str, int, bool]]:
        """Time, kind, side, and whether the state (not a jump) triggered it."""
        trajectories = [*(trajectory for _, trajectory in self.past), self.trajectory]
        return [
            (time, kind, side, not forced)
            for trajectory in trajectories
            for time, kind, side, forced in trajectory.events()
        ]


def _refuse_rate_limit(controller: Law) -> None:
    if controller.rate_limit is not None:
        raise InvalidInput("controller rate_limit needs a sampled controller: set its sample_rate")


def start_zone(error: float, enter: float) -> str:
    """The dead zone's mode at the start: closed, unless the error is already small enough to open the loop."""
    if abs(error) <= enter:
        return "inside"
    return "+" if error > 0.0 else "-"


def controller_constants(controller: Law) -> dict[str, float]:
    """States of the automaton that are constants of the controller, by name."""
    most = controller.voltage_limit
    limit = {} if most is None else {"voltage limit": most}
    return {"feedforward": controller.feedforward, **limit}


def friction_feedforward(controller: Law) -> float:
    """Command added with the sign of the reference's last change; linear laws add none."""
    return controller.friction_feedforward if isinstance(controller, Controller) else 0.0


def at_zero(pieces: PiecewiseCubic) -> Array:
    """Ascending coefficients, about time 0, of the piece in force there."""
    return about(pieces, 0.0)


@dataclass(frozen=True)
class LoopState:
    """Automaton, state and mode of a continuous loop at one instant."""

    loop: ServoAutomaton
    state: Array
    mode: int

    @property
    def zone(self) -> str:
        """The controller's zone."""
        return self.loop.zones[self.mode % len(self.loop.zones)]

    def output(self, name: str) -> float:
        """An output at this instant."""
        return float(self.loop.rows[name][self.mode] @ self.state)

    def value(self, name: str) -> float:
        """A state by name."""
        return float(self.state[self.loop.automaton.index(name)])


def change_controller(
    now: LoopState, controller: Law, values: Mapping[str, float], loop: Callable[[bool], ServoAutomaton]
) -> LoopState:
    """Replace the controller in the running loop: common states go on, the voltage does not jump.

    As `control.law.transfer` does for the sampled law: the difference to the old controller's voltage at this instant
    becomes an offset that fades exponentially. Voltage beyond the old controller's limit is dropped.

    Parameters
    ----------
    now : LoopState
    controller : Controller
        The new controller.
    values : dict
        States by name that the change sets.
    loop : callable
        The automaton with the new controller, with or without a state "offset".
    """
    place = _with_states(now, controller, loop(False), values)
    offset = now.output("voltage") - place.output("voltage")
    if offset == 0.0:
        return place
    return _with_states(now, controller, loop(True), {**values, "offset": offset})


def law_at_rest(law: LinearLaw, now: LoopState, known: dict[str, float], command: float = 0.0) -> dict[str, float]:
    """States of a linear law in the automaton, at rest under the present measurements; some of them given, or all of
    them such that they give a command, where they can."""
    y_motor, y_load = now.output("theta_m"), now.output("sensed")
    by_motor, by_load = law.error
    reference = by_motor * y_motor + by_load * y_load if not known else now.value("reference")
    inputs = (reference, y_motor, y_load)
    resting = holding_states(law, inputs, command) or law.rest(inputs, known)
    return {law_state(name): value for name, value in zip(law.names, resting, strict=True)}


def _with_states(now: LoopState, controller: Law, loop: ServoAutomaton, values: Mapping[str, float]) -> LoopState:
    """Carry the states over by name. Without integral action nothing would correct the integral: its part goes into the
    offset."""
    common = {name: now.value(name) for name in now.loop.automaton.names if name != "offset"}
    if isinstance(controller, LinearLaw):
        running = {name: common[law_state(name)] for name in controller.names if law_state(name) in common}
        common |= law_at_rest(controller, now, running)
    else:
        common |= {"integral": 0.0} if controller.Ki == 0.0 else {}
    if isinstance(controller, Controller) and controller.integral_only:
        common["integral"] -= replaced(common["integral"], controller.feedforward - common.get("feedforward", 0.0))
    # A filter that is new starts at what it filters: at zero it would show a jump of it.
    new = {"filtered": now.output("measured_position"), "lagging": now.value("reference")}
    common = new | common | dict(values)
    state = np.array([common.get(name, 0.0) for name in loop.automaton.names])
    zone = now.zone.split()[0]
    if zone != "on":
        error, tolerance = float(loop.rows["error"][0] @ state), common["tolerance"]
        zone = _zone_after(zone, error, controller.enter * tolerance, controller.leave * tolerance)
    # Contact and stick-slip modes stay: both automata number them alike.
    mode = now.mode // len(now.loop.zones) * len(loop.zones) + loop.zones.index(zone)
    names = loop.automaton.names
    if isinstance(controller, Controller) and "notch low" in names and "notch low" not in common:
        # At rest at what it filters, which drives the band-pass.
        driven = float(loop.automaton.flows[mode][loop.automaton.index("notch band")] @ state)
        state[loop.automaton.index("notch low")] = driven / (2.0 * math.pi * controller.notch_hz)
    return LoopState(loop, state, mode)


def _zone_after(zone: str, error: float, enter: float, leave: float) -> str:
    """The dead zone's mode for new thresholds, by the hysteresis of the law."""
    side = "+" if error > 0.0 else "-"
    if zone == "inside":
        return side if abs(error) > leave else zone
    return "inside" if abs(error) < enter else (side if error else zone)
