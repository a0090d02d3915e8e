"""Many continuous runs at once, on all threads: of one servo, or each with its own servo and controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.control.controller import Controller
from servotwin.control.laws import filtered_pid
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, AutomatonStack
from servotwin.hybrid.ensemble import FigureOptions, Members, figures_of_family, run_family
from servotwin.hybrid.members import Figures
from servotwin.plant.automaton import Shape, without_feedforward
from servotwin.plant.plants import Plant, structure_of
from servotwin.plant.signals import LARGEST_GAP, check_gap
from servotwin.plant.stack import LoopStack, continuous_loops
from servotwin.simulation.continuous import controller_constants
from servotwin.simulation.ensemble_starts import starts_of, zones_at
from servotwin.simulation.inputs import with_forces
from servotwin.simulation.start import holding_integral

NOT_NEGATIVE = ("gap", "tolerance", "friction")


class Cases(NamedTuple):
    """Constants of each run, any shapes that broadcast.

    Attributes
    ----------
    reference, gap, tolerance, theta_d0 : array_like
        m, rad (total), m, rad. A tolerance of 0 is no dead zone, a gap of 0 no backlash.
    input_bias, friction : array_like
        V behind the controller, N m on the motor's shaft.
    """

    reference: ArrayLike = 0.0
    gap: ArrayLike = 0.0
    tolerance: ArrayLike = 0.0
    theta_d0: ArrayLike = 0.0
    input_bias: ArrayLike = 0.0
    friction: ArrayLike = 0.0


@dataclass(frozen=True)
class Group:
    """Members of one structure.

    Attributes
    ----------
    which : (k,) array
        Their indices among all members.
    automata : AutomatonStack
        The different automata, each once.
    rows : (A, O, M, n) array
        Outputs of each automaton.
    members : Members
    loops : LoopStack
    enter : (k,) array
        m, error below which the dead zone of each member is entered.
    """

    which: NDArray[np.int64]
    automata: AutomatonStack
    rows: Array
    members: Members
    loops: LoopStack
    enter: Array

    def restarted(self, states: Array) -> Members:
        """The members in other (k, n) states."""
        automaton = self.members.automaton
        return Members(automaton, _modes_at(self.loops, automaton, states, self.enter), states)


def _modes_at(loops: LoopStack, automaton: NDArray[np.int64], states: Array, enter: Array) -> NDArray[np.int64]:
    """(k,) modes by the error in each state; `enter` (m) matters only with a dead zone."""
    if "inside" not in loops.first.zones:
        return np.full(len(states), loops.first.mode("on"))
    error = np.sum(states * loops.rows["error"][automaton, 0], axis=1)
    return zones_at(loops.first, error, enter)


@dataclass(frozen=True)
class EnsembleMembers:
    """All members, flat.

    Attributes
    ----------
    shape : tuple of int
        Shape that servos, controllers and constants broadcast to.
    """

    shape: tuple[int, ...]
    servos: list[Plant]
    controllers: list[Controller]
    constants: dict[str, Array]

    def groups(self, outputs: Sequence[str]) -> list[Group]:
        """Members by structure."""
        # One group shares states, modes and guards, so one call of the compiled kernel runs it on all threads.
        by_structure: dict[object, list[int]] = {}
        shapes = [self._shape_of(member) for member in range(len(self.servos))]
        for member, shape in enumerate(shapes):
            key = (shape, *_structure_of(self.servos[member], self.controllers[member]))
            by_structure.setdefault(key, []).append(member)
        return [self._group(np.array(which), shapes[which[0]], outputs) for which in by_structure.values()]

    def _shape_of(self, member: int) -> Shape:
        return Shape(
            dead_zone=self.constants["tolerance"][member] > 0.0,
            bias=self.constants["input_bias"][member] != 0.0,
            friction=self.constants["friction"][member] > 0.0,
            feedforward=self.controllers[member].feedforward != 0.0,
            friction_feedforward=self.controllers[member].friction_feedforward != 0.0,
        )

    def _group(self, which: NDArray[np.int64], shape: Shape, outputs: Sequence[str]) -> Group:
        servos, laws = ([values[member] for member in which] for values in (self.servos, self.controllers))
        places: dict[tuple[Plant, Controller], int] = {}
        pairs = [(servo, without_feedforward(law)) for servo, law in zip(servos, laws, strict=True)]
        automaton = np.array([places.setdefault(pair, len(places)) for pair in pairs])
        loops = continuous_loops([servo for servo, _ in places], [law for _, law in places], shape)
        constants = {name: values[which] for name, values in self.constants.items()} | _constants_of(laws)
        starts = starts_of(loops, automaton, constants)
        states = starts.states
        held = [holding_integral(law, each) for law, each in zip(laws, starts.commands.tolist(), strict=True)]
        states[:, loops.first.automaton.index("integral")] = held
        if shape.friction_feedforward:
            moved = constants["reference"] - np.sum(states * loops.rows["measured_position"][automaton, 0], axis=1)
            fed = np.array([law.friction_feedforward for law in laws])
            states[:, loops.first.automaton.index("friction feedforward")] = fed * np.sign(moved)
        enter = np.array([law.enter for law in laws]) * constants["tolerance"]
        modes = _modes_at(loops, automaton, states, enter) + starts.sides * loops.first.modes_per_contact
        for name in outputs:
            if name not in loops.rows:
                raise InvalidInput(f"an ensemble has no output {name!r}; allowed are {', '.join(loops.rows)}")
        rows = np.stack([loops.rows[name] for name in outputs], axis=1)
        return Group(which, loops.automata, rows, Members(automaton, modes, states), loops, enter)


def simulate_members(
    servos: Any,
    controllers: Any,
    duration: float,
    cases: Cases,
    outputs: Sequence[str] = ("error", "voltage"),
    sample_rate: float = 100.0,
    threads: int | None = None,
) -> dict[str, Array]:
    """Several outputs of many runs from rest, each with a servo and a controller of its own.

    Parameters
    ----------
    servos : Servo or array_like of Servo
    controllers : Controller or array_like of Controller, or None
        Continuous; None: the servo's own.
    duration : float
        s.
    cases : Cases
        Constants of each run. They, `servos` and `controllers` are broadcast against each other to shape S.
    outputs : sequence of str
        Rows of `ServoAutomaton`: error, voltage, position, theta_m, theta_d, q1, ...
    sample_rate : float
        Hz, of the outputs; events are searched for on a step of their own.
    threads : int, optional
        As many as there are processors by default.

    Returns
    -------
    dict of (*S, N) arrays
        By output, ``N = round(duration * sample_rate) + 1``.

    Raises
    ------
    InvalidInput
        A controller that is not continuous, a constant out of its range, an output that does not exist.
    """
    members, samples = members_of(servos, controllers, cases), samples_of(duration, sample_rate)
    traces = np.empty((len(members.servos), len(outputs), samples))
    for group in members.groups(outputs):
        traces[group.which] = run_family(
            group.automata, group.rows, group.members, 1.0 / sample_rate, samples, threads
        )[0]
    return {name: traces[:, o].reshape(*members.shape, -1) for o, name in enumerate(outputs)}


def summarise_members(
    servos: Any,
    controllers: Any,
    duration: float,
    cases: Cases,
    last: float,
    limits: Mapping[str, ArrayLike] | None = None,
    outputs: Sequence[str] = ("error", "voltage", "theta_m"),
    sample_rate: float = 100.0,
    threads: int | None = None,
) -> dict[str, Figures]:
    """Run as `simulate_members` does, and reduce the samples of each output to figures.

    Parameters
    ----------
    servos, controllers, duration, outputs, sample_rate, threads
        As for `simulate_members`.
    cases : Cases
        Constants of each run.
    last : float
        s, length of the last part of a run, which has figures of its own.
    limits : dict of array_like, optional
        By output, the absolute value beyond which a sample is outside; infinite for outputs not named.

    Returns
    -------
    dict of Figures
        By output, arrays of shape S.

    Raises
    ------
    InvalidInput
        As `simulate_members`; also for limits of an output that is not listed, or a `last` longer than the run.
    """
    members, last_samples = members_of(servos, controllers, cases), round(last * sample_rate)
    bounds = np.full((len(members.servos), len(outputs)), np.inf)
    for name, limit in (limits or {}).items():
        if name not in outputs:
            raise InvalidInput(f"limits name {name!r}, which is none of the outputs {', '.join(outputs)}")
        bounds[:, outputs.index(name)] = np.broadcast_to(limit, members.shape).ravel()
    values = np.empty((len(bounds), len(outputs), len(Figures._fields)))
    for group in members.groups(outputs):
        options = FigureOptions(bounds[group.which], last_samples)
        figures = figures_of_family(
            group.automata,
            group.rows,
            group.members,
            1.0 / sample_rate,
            samples_of(duration, sample_rate),
            options,
            threads,
        )
        values[group.which] = np.stack(figures, axis=2)
    by_output = np.moveaxis(values, (1, 2), (0, 1)).reshape(len(outputs), -1, *members.shape)
    return {name: Figures(*figures) for name, figures in zip(outputs, by_output, strict=True)}


def samples_of(duration: float, sample_rate: float) -> int:
    """Number of samples of a run, both ends included."""
    if not (0.0 < duration < np.inf and 0.0 < sample_rate < np.inf):
        raise InvalidInput(f"duration = {duration} s at sample_rate = {sample_rate} Hz: must be positive and finite")
    return round(duration * sample_rate) + 1


def members_of(servos: Any, controllers: Any, cases: Cases) -> EnsembleMembers:
    """Broadcast servos, controllers and constants to members.

    Raises
    ------
    InvalidInput
        A controller that is not continuous or limits the rate, a constant that is not finite or negative.
    """
    plants, laws = np.asarray(servos, dtype=object), np.asarray(controllers, dtype=object)
    values = [np.asarray(value, dtype=float) for value in cases]
    shape = np.broadcast_shapes(plants.shape, laws.shape, *(value.shape for value in values))
    constants = {name: np.broadcast_to(value, shape).ravel() for name, value in zip(Cases._fields, values, strict=True)}
    check_constants(constants, plants)
    every_servo = list(np.broadcast_to(plants, shape).ravel())
    given = np.broadcast_to(laws, shape).ravel()
    every_law = [
        filtered_pid(servo.controller if law is None else law) for servo, law in zip(every_servo, given, strict=True)
    ]
    # Thousands of members share a few controllers: each is checked once.
    for law in {id(law): law for law in every_law}.values():
        if law.sample_rate is not None or law.rate_limit is not None:
            raise InvalidInput("an ensemble needs continuous controllers: without sample_rate and rate_limit")
    return EnsembleMembers(shape, every_servo, every_law, with_forces(constants, every_servo))


def check_constants(constants: dict[str, Array], plants: NDArray[Any]) -> None:
    """Refuse constants that are not finite, or negative where they must not be."""
    for name, values in constants.items():
        allowed = "finite and 0 or more" if name in NOT_NEGATIVE else "finite"
        if not np.isfinite(values).all() or (name in NOT_NEGATIVE and values.min(initial=0.0) < 0.0):
            raise InvalidInput(f"{name}: every value of an ensemble must be {allowed}")
    largest = max((plant.largest_gap for plant in plants.ravel()), default=LARGEST_GAP)
    check_gap(float(constants["gap"].max(initial=0.0)), largest=largest)


def _structure_of(servo: Plant, law: Controller) -> tuple[object, ...]:
    limits = law.voltage_limit is None, law.loop_filter_hz is None
    return structure_of(servo), *limits, law.integral_only, law.velocity_feedforward == 0.0, law.notch_hz == 0.0


def _constants_of(laws: list[Controller]) -> dict[str, Array]:
    """(k,) states that are constants of the controllers, by name."""
    each = {id(law): controller_constants(law) for law in laws}
    return {name: np.array([each[id(law)][name] for law in laws]) for name in controller_constants(laws[0])}
