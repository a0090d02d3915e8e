"""Start of a run: the plant at rest, and under a constant force the law with the command that holds the load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.law import LawState
from servotwin.control.law import start as law_start
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearState
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.law_loop import law_matrices
from servotwin.plant.plants import Plant

# A law holds a command where the rest of its equations is met to this part of it.
_ROUNDING = 1e-9


class PlantStart(NamedTuple):
    """State of an automaton at rest, the command (in its actuator's unit) that keeps it there, and the flank on which
    the load hangs (0: none)."""

    state: Array
    command: float = 0.0
    side: int = 0


def plant_start(servo: Plant, loop: ServoAutomaton, gap: float, theta_d0: float) -> PlantStart:
    """At rest: motor at 0, screw at `theta_d0` clamped into the gap, structure in equilibrium.

    A load that a constant force pushes, gravity for one, hangs in equilibrium with the measured position at 0; of a
    driven end that is held in the gap `theta_d0` counts from the motor.
    """
    if not np.isfinite(theta_d0):
        raise InvalidInput(f"theta_d0 = {theta_d0} rad: must be finite")
    state = np.zeros(len(loop.automaton.names))
    screw, angle = float(np.clip(theta_d0, -0.5 * gap, 0.5 * gap)), loop.automaton.index("theta_d")
    hanging = servo.rest_under_force(gap, screw)
    if hanging is not None:
        state[:angle], state[angle] = hanging.motor, hanging.screw
        state[angle + 1 : angle + 1 + hanging.load.size] = hanging.load
        return PlantStart(state, hanging.command, hanging.side)
    if screw:
        screw, rest = servo.at_rest(screw)
        state[angle], state[angle + 1 : angle + 1 + rest.size] = screw, rest
        set_states(loop, state, {"sensed": 0.0 if servo.at_motor else servo.p * screw})
    return PlantStart(state)


def set_states(loop: ServoAutomaton, state: Array, values: Mapping[str, float]) -> None:
    """Set the named states; names that the automaton lacks are ignored."""
    for name, value in values.items():
        if name in loop.automaton.names:
            state[loop.automaton.index(name)] = value


def holding_integral(law: Controller, command: float) -> float:
    """Integral of a filtered PID that gives a command at no error, within its limit; 0 without integral action."""
    if law.Ki == 0.0 or command == 0.0:
        return 0.0
    held = command if law.voltage_limit is None else float(np.clip(command, -law.voltage_limit, law.voltage_limit))
    return held - law.feedforward


def started(law: Controller, measured: float, command: float) -> LawState:
    """State of a sampled filtered PID at rest at a measurement (m or rad), with a command that holds the load."""
    integral = holding_integral(law, command)
    return law_start(measured)._replace(integral=integral, voltage=integral + law.feedforward if integral else 0.0)


def holding_states(law: LinearLaw, inputs: tuple[float, float, float], command: float) -> tuple[float, ...] | None:
    """States of a linear law at rest under inputs (reference, y_motor, y_load) that give a command; None: there are
    none."""
    if command == 0.0 or law.n == 0:
        return None
    A, B, C, D = law_matrices(law)
    resting = A - np.eye(law.n) if law.discrete else A
    rows, u = np.vstack([resting, C]), np.array(inputs)
    wanted = np.append(-B @ u, command - law.feedforward - D @ u)
    # Rows have units of their own.
    sizes = np.maximum(np.abs(rows).max(axis=1), np.finfo(float).tiny)
    states = np.linalg.lstsq(rows / sizes[:, None], wanted / sizes, rcond=None)[0]
    left = np.abs(rows @ states - wanted)
    scale = np.abs(rows) @ np.abs(states) + np.abs(wanted)
    return tuple(states.tolist()) if bool(np.all(left <= _ROUNDING * scale)) else None


def linear_start(law: LinearLaw, y_motor: float, y_load: float, command: float) -> LinearState:
    """State of a sampled linear law at rest at measurements, with a command that holds the load."""
    at_rest = law.start(y_motor, y_load)
    reference = law.error[0] * y_motor + law.error[1] * y_load
    held = holding_states(law, (reference, y_motor, y_load), command)
    return at_rest if held is None else at_rest._replace(states=law.padded(held), command=command)
