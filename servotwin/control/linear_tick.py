"""The tick of every linear law, written once: a pure step on floats and tuples of floats.

As `control.law`, which is the tick of the filtered PID: the interpreter runs it at the edge, numba compiles the very
same function for simulation, and both give the same bits.
"""

from collections.abc import Sequence
from math import inf
from typing import NamedTuple


class LinearParameters(NamedTuple):
    """Parameters of the tick; made by `LinearLaw.parameters`. A law of n states.

    Attributes
    ----------
    advance : (2 n (n + 4),) sequence of float
        The next states, row by row, from (states, reference, y_motor, y_load, what the limits cut off); first outside
        the dead zone, then inside.
    output : (2 (n + 3),) sequence of float
        The command from (states, reference, y_motor, y_load); first outside, then inside.
    motor, load : float
        The error of the dead zone is reference - motor y_motor - load y_load.
    enter, leave : float
        Error at or below which the zone is entered and above which it is left, m or rad; negative: no dead zone.
    limit : float
        Largest command, in its unit; inf: none.
    rate_step : float
        Its largest change per tick; inf: none.
    feedforward : float
        Always added to the command.
    release_step : float
        Share of `LinearState.offset` that fades per tick.
    """

    advance: Sequence[float]
    output: Sequence[float]
    motor: float
    load: float
    enter: float
    leave: float
    limit: float
    rate_step: float
    feedforward: float
    release_step: float


class LinearState(NamedTuple):
    """State of a linear law between two ticks.

    Attributes
    ----------
    states : (n,) tuple of float
    command : float
        Given at the last tick.
    active : float
        1.0: the error is outside the dead zone; 0.0: inside.
    offset : float
        Added to the command after a change of the law; it fades exponentially.
    """

    states: tuple[float, ...]
    command: float
    active: float
    offset: float


def linear_tick(
    parameters: LinearParameters, state: LinearState, reference: float, y_motor: float, y_load: float
) -> LinearState:
    """One sample of a linear law with dead zone, limit and rate limit.

    Parameters
    ----------
    parameters, state : LinearParameters, LinearState
        The law in force and its state after the previous tick.
    reference : float
        m (rotary: rad).
    y_motor, y_load : float
        Measured angle of the motor, rad, and position of the load, m (rotary: rad).

    Returns
    -------
    LinearState
        The new state; `command` is to be applied until the next tick.
    """
    size = abs(reference - (parameters.motor * y_motor + parameters.load * y_load))
    active = state.active
    if active > 0.5:
        if size <= parameters.enter:
            active = 0.0
    elif size > parameters.leave:
        active = 1.0
    n = len(state.states)
    inputs = state.states + (reference, y_motor, y_load)  # noqa: RUF005 - numba compiles no unpacking here
    place = 0 if active > 0.5 else n + 3
    unlimited = parameters.feedforward + state.offset
    for value in inputs:
        unlimited = unlimited + parameters.output[place] * value
        place += 1
    command = unlimited
    if command > parameters.limit:
        command = parameters.limit
    elif command < -parameters.limit:
        command = -parameters.limit
    # The rate limit comes last: it counts from the command applied before.
    if command > state.command + parameters.rate_step:
        command = state.command + parameters.rate_step
    elif command < state.command - parameters.rate_step:
        command = state.command - parameters.rate_step
    cut = command - unlimited
    states = state.states
    place = 0 if active > 0.5 else n * (n + 4)
    for _ in range(n):
        following = 0.0
        for value in inputs:
            following = following + parameters.advance[place] * value
            place += 1
        following = following + parameters.advance[place] * cut
        place += 1
        # A new one behind, the oldest in front falls off: a tuple that numba knows the length of.
        states = states[1:] + (following,)  # noqa: RUF005
    return LinearState(states, command, active, state.offset * (1.0 - parameters.release_step))


def linear_transfer(
    old: LinearParameters,
    new: LinearParameters,
    state: LinearState,
    carried: tuple[float, ...],
    inputs: tuple[float, float, float],
) -> LinearState:
    """Change the law without a bump: the state with which the next tick of `new` gives the command of `old`.

    Parameters
    ----------
    old, new : LinearParameters
        The law so far and the law to come, equally limited.
    state : LinearState
        After the last tick of `old`.
    carried : tuple of float
        States of the new law; `LinearLaw.carried` makes them of the old one's.
    inputs : tuple of float
        Reference, y_motor and y_load of the tick that is due.

    Returns
    -------
    LinearState
        For the first tick of `new`. The difference between the two laws is in the offset and fades with it; the part of
        the old command beyond its limits is dropped.
    """
    command = linear_tick(old, state, *inputs).command
    moved = LinearState(carried, state.command, state.active, 0.0)
    unlimited = new._replace(limit=inf, rate_step=inf)
    return moved._replace(offset=command - linear_tick(unlimited, moved, *inputs).command)
