"""Starts of many continuous members: states at rest, and the modes that hold there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.stack import LoopStack


class Starts(NamedTuple):
    """Starts of members: (k, n) states at rest, (k,) commands that keep them there, and (k,) flanks on which the loads
    hang (0: none)."""

    states: Array
    commands: Array
    sides: NDArray[np.int64]


def starts_of(loops: LoopStack, which: NDArray[np.int64], constants: dict[str, Array]) -> Starts:
    """Members at rest, each of the automaton of its number: `plant_start` for many members."""
    names, index = loops.first.automaton.names, loops.first.automaton.index
    states = np.zeros((len(constants["gap"]), len(names)))
    for name, values in constants.items():
        key = name.replace("_", " ")
        if key in names:
            states[:, index(key)] = values
    half = 0.5 * constants["gap"]
    screw, first = np.clip(constants["theta_d0"], -half, half), index("theta_d") + 1
    angle, rest = (each[which] for each in loops.plants.at_rest())
    states[:, first - 1] = angle * screw
    states[:, first : first + rest.shape[1]] = screw[:, None] * rest
    commands, sides = np.zeros(len(states)), np.zeros(len(states), dtype=np.int64)
    if "sensed" in names and not loops.plants.at_motor:
        states[:, index("sensed")] = loops.plants.p[which, 0] * states[:, first - 1]
    for follower in ("filtered", "lagging"):
        if follower in names:
            states[:, index(follower)] = np.sum(states * loops.rows["measured_position"][which, 0], axis=1)
    if loops.plants.guide.force:
        for member, (plant, gap, angle) in enumerate(zip(which, constants["gap"], screw, strict=True)):
            _hang(loops, int(plant), float(gap), float(angle), member, Starts(states, commands, sides))
    return Starts(states, commands, sides)


def _hang(loops: LoopStack, plant: int, gap: float, screw: float, member: int, starts: Starts) -> None:
    """Hang the load of a member that a force pushes."""
    hanging = loops.plants.rest_under_force(plant, gap, screw)
    if hanging is None:
        return
    first = loops.first.automaton.index("theta_d")
    state = starts.states[member]
    state[:first], state[first] = hanging.motor, hanging.screw
    state[first + 1 : first + 1 + hanging.load.size] = hanging.load
    for name in ("sensed", "filtered", "lagging"):
        if name in loops.first.automaton.names:
            state[loops.first.automaton.index(name)] = 0.0
    starts.commands[member], starts.sides[member] = hanging.command, hanging.side


def start_modes(loop: ServoAutomaton, states: Array, enter: float) -> NDArray[np.int64]:
    """(k,) modes: `start_zone` for many members."""
    if "inside" not in loop.zones:
        return np.full(len(states), loop.mode("on"))
    error = states @ loop.rows["error"][0]
    return zones_at(loop, error, enter * states[:, loop.automaton.index("tolerance")])


def zones_at(loop: ServoAutomaton, error: Array, enter: Array) -> NDArray[np.int64]:
    """(k,) modes of a loop with a dead zone, by the error and the threshold of each member."""
    inside = np.abs(error) <= enter
    return np.where(inside, loop.mode("inside"), np.where(error > 0.0, loop.mode("+"), loop.mode("-")))
