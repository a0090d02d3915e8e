"""The loop in units of its gap, its reference shifted to zero where that changes nothing, and its symmetries.

Two maps take motions of the automaton to motions: a shift of everything that is a position, and the mirror. Both are
verified on the matrices, not assumed: a screw whose load acts back has no shift, a bias no mirror.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.analysis.limit_cycles.poincare import Flags, GuardId
from servotwin.control.laws import AnyController, Law, filtered_pid, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.axis import Axis
from servotwin.plant.margins import gain_crossovers
from servotwin.plant.plants import Plant
from servotwin.simulation.continuous import ContinuousEngine
from servotwin.simulation.simulate import Simulation

# Lengths of a symmetric interval are not mirrored.
_WIDTHS = ("gap", "tolerance", "voltage limit", "drive limit")
_SWAPPED = str.maketrans("-+", "+-")
_ROUNDING = 1e-9


def moving(loop: ServoAutomaton) -> Flags:
    """(n,) booleans: the states that some mode's flow changes. The others (reference, gap, tolerance, limits, and an
    integral without gain) are constants: each would add a neutral direction to every orbit."""
    return np.asarray(np.any(loop.automaton.flows != 0.0, axis=(0, 2)))


def shift(servo: Plant, loop: ServoAutomaton) -> Array | None:
    """(n,) displacement of a motion per metre of reference, or None where a shifted motion is no motion.

    Motor, screw and masses are moved alike. Where every flow and every guard ignores that, orbits for any reference are
    one orbit; where the load holds the motor, they are not.
    """
    automaton = loop.automaton
    screw, rest = servo.at_rest(1.0 / servo.p)
    result = np.zeros(len(automaton.names))
    for name, moved in {"theta_m": 1.0 / servo.p, "theta_d": screw, "reference": 1.0, "filtered": 1.0}.items():
        if name in automaton.names:
            result[automaton.index(name)] = moved
    first = automaton.index("theta_d") + 1
    result[first : first + rest.size] = rest
    rows = [np.asarray(guard.row, dtype=float) for mode in automaton.modes for guard in mode.guards]
    everything = np.vstack([automaton.flows.reshape(-1, len(automaton.names)), *rows])
    ignored = np.abs(everything @ result) <= _ROUNDING * (np.abs(everything) @ np.abs(result))
    return result if bool(np.all(ignored)) else None


@dataclass(frozen=True, eq=False)
class Mirror:
    """The reflection of a motion in its centre.

    Attributes
    ----------
    signs : (n,) array
        -1 for every state that changes its sign.
    guards : dict
        The event that mirrors each event.
    """

    signs: Array
    guards: dict[GuardId, GuardId]


def mirror(loop: ServoAutomaton) -> Mirror | None:
    """The mirror of a loop, or None where it has none."""
    automaton = loop.automaton
    signs = np.array([1.0 if name in _WIDTHS else -1.0 for name in automaton.names])
    names = [mode.name for mode in automaton.modes]
    guards: dict[GuardId, GuardId] = {}
    for index, mode in enumerate(automaton.modes):
        other = _opposite(mode.name)
        if other not in names:
            return None
        partner = automaton.modes[names.index(other)]
        if not np.array_equal(automaton.flows[names.index(other)], signs[:, None] * automaton.flows[index] * signs):
            return None
        for g, guard in enumerate(mode.guards):
            target = _opposite(names[guard.target])
            row = np.asarray(guard.row) * signs
            matches = [
                k
                for k, candidate in enumerate(partner.guards)
                if names[candidate.target] == target and np.array_equal(np.asarray(candidate.row), row)
            ]
            if len(matches) != 1:
                return None
            guards[GuardId(index, g)] = GuardId(names.index(other), matches[0])
    return Mirror(signs, guards)


def _opposite(name: str) -> str:
    """The name of the mirrored mode: sides swapped, saturated high and low too."""
    swapped = name.translate(_SWAPPED)
    if swapped.endswith("high"):
        return swapped.removesuffix("high") + "low"
    return swapped.removesuffix("low") + "high" if swapped.endswith("low") else swapped


# Samples per characteristic time; the kernel searches for events on a step of its own.
LOOKS = 64


@dataclass(frozen=True, eq=False)
class ScaledLoop:
    """A loop at rest just after a reference step, divided by `unit`; the loop is homogeneous, so nothing else changes.

    Attributes
    ----------
    loop : ServoAutomaton
    state, mode : (n,) array, int
        At time 0.
    unit : float
        Factor from scaled states to SI units.
    displacement : (n,) array
        Added after scaling: the shift of the reference to zero.
    extent : float
        Scaled metres, of the gap at the screw (or of the tolerance, or of the step, where there is no gap).
    time : float
        s, one turn at the first gain crossover of the loop without a gap.
    free : (n,) boolean array
        States that move.
    mirror : Mirror or None
        The symmetry that the motions from this state have.
    """

    loop: ServoAutomaton
    state: Array
    mode: int
    unit: float
    displacement: Array
    extent: float
    time: float
    free: Flags
    mirror: Mirror | None

    @property
    def sample_step(self) -> float:
        """Spacing of samples, s."""
        return self.time / LOOKS

    def actual(self, state: Array) -> Array:
        """A state in SI units and with its reference."""
        return np.asarray(self.unit * state + self.displacement)


def scaled_loop(
    servo: Plant, gap: float, tolerance: float | None, controller: AnyController | None, step: float
) -> ScaledLoop:
    """The loop at rest just after a reference step (m); see `limit_cycle`.

    Raises
    ------
    InvalidInput
        The controller is sampled or has a rate limit, or a number is outside its range.
    """
    law = law_of(servo.controller if controller is None else controller)
    if law.sample_rate is not None:
        rate = f"sample_rate = {law.sample_rate:g} Hz"
        raise InvalidInput(f"controller {rate}: limit cycles are those of the continuous law; give sample_rate = None")
    if not (math.isfinite(gap) and gap >= 0.0):
        raise InvalidInput(f"gap = {gap!r} rad: must be finite and 0 or more")
    dead_zone = tolerance if tolerance else None
    time = characteristic_time(servo, law)
    engine = Simulation(servo, time, controller=law, reference=step, gap=gap, tolerance=dead_zone).engine
    assert isinstance(engine, ContinuousEngine)
    loop, state, mode = engine.loop, engine.trajectory.state, engine.trajectory.mode
    direction, free = shift(servo, loop), moving(loop)
    displacement = np.zeros(len(state)) if direction is None else step * direction
    unit = gap or (dead_zone or abs(step)) / servo.p
    scaled = (state - displacement) / unit
    reflection = mirror(loop)
    # A constant that the mirror would turn round must be zero for it to map motions to motions of the same loop.
    if reflection is not None and np.any(scaled[~free & (reflection.signs < 0.0)] != 0.0):
        reflection = None
    return ScaledLoop(loop, scaled, mode, unit, displacement, servo.p, time, free, reflection)


def characteristic_time(servo: Plant, controller: Law) -> float:
    """s: one turn at the first gain crossover without a gap, or, where there is none, of the slowest lasting motion."""
    if isinstance(servo, Axis) and isinstance(controller, LinearLaw):
        crossovers = servo.margins(controller).gain_crossovers
        closed = servo.closed_loop(controller)
    else:
        pid = filtered_pid(controller)
        crossovers, closed = gain_crossovers(servo.loop(pid)), servo.closed_loop(pid)
    if crossovers:
        return 2.0 * math.pi / crossovers[0].omega
    sizes = np.abs(closed.poles())
    return float(2.0 * math.pi / np.min(sizes[sizes > 0.0]))
