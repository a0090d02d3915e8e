"""Comparison of a recorded command with that of a stated cascade or linear law, as of a filtered PID in `controller`.

Beside its dead zone and its limits such a law is linear in its states and inputs. Its states before the window are
fitted; a cascade is also compared with other gains of its two loops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import cast

import numpy as np

from servotwin.control import linear_tick
from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearParameters, LinearState
from servotwin.estimation.first_states import command_from_best_states, least_squares, rms
from servotwin.estimation.window import MINIMUM_SAMPLES, Window
from servotwin.hybrid.compiled import compiled, verbatim
from servotwin.plant.signals import Array

tick = verbatim(linear_tick.linear_tick)

_TWICE, _NEAR = 2, 1e-3  # samples in a tick: fewest that count; of a whole number of them
_DRAWS = 7  # seed of the noise whose effect on the command is computed


@compiled
def run_linear(parameters: LinearParameters, start: LinearState, inputs: Array) -> Array:
    """Commands (n,) of a linear law over recorded inputs (n, 3): reference, motor's angle, position."""
    commands = np.empty(len(inputs))
    state = start
    for k in range(len(inputs)):
        state = tick(parameters, state, inputs[k, 0], inputs[k, 1], inputs[k, 2])
        commands[k] = state.command
    return commands


def at_rate(law: Cascade | LinearLaw, rate: float) -> LinearLaw | None:
    """The law as it runs at a rate (Hz); None for one that is stated in ticks of another rate."""
    if isinstance(law, Cascade):
        return law.replace(sample_rate=rate).linear()
    if law.discrete and law.sample_rate is not None and abs(rate / law.sample_rate - 1.0) > _NEAR:
        return None
    return law if law.discrete else law.replace(sample_rate=rate)


def at_ticks(window: Window, law: Cascade | LinearLaw) -> Window:
    """The samples of a window at which a law of a slower rate gave its commands; the window, where there is none."""
    if law.sample_rate is None or window.voltage is None:
        return window
    ratio = window.sample_rate / law.sample_rate
    every = round(ratio)
    if every < _TWICE or abs(ratio - every) > _NEAR * every or window.voltage.size < 2 * every * MINIMUM_SAMPLES:
        return window
    changes = np.flatnonzero(np.diff(window.voltage)) + 1
    first = int(np.argmax(np.bincount(changes % every, minlength=every)))

    def at(values: Array | None) -> Array | None:
        return None if values is None else values[first::every]

    return Window(
        at(window.measured_position),
        at(window.theta_m),
        at(window.voltage),
        at(window.reference),
        sample_rate=window.sample_rate / every,
    )


def command_from_best_start(law: LinearLaw, tolerance: float, command: Array, inputs: Array) -> Array:
    """Command (n,) of a law from the first states that fit the recorded one best.

    Parameters
    ----------
    law : LinearLaw
        With a sample rate.
    tolerance : float
        Half-width of its dead zone; 0: none.
    command : (n,) array
        As recorded.
    inputs : (n, 3) array
        Reference, motor's angle, and position.
    """
    parameters, first = _flat(law.parameters(tolerance)), _start(law, inputs)
    best, least = np.zeros(0), math.inf
    for active in (1.0, 0.0) if parameters.enter < parameters.leave else (1.0,):
        state = first._replace(command=float(command[0]), active=active)
        outside = parameters._replace(enter=-1.0, leave=-1.0)
        effect = np.abs(first_states(law, outside, state, inputs)).max(axis=0)
        units = np.divide(1.0, effect, out=np.zeros(effect.size), where=effect > 0.0)

        def run(by: Array, parameters: LinearParameters = parameters, state: LinearState = state) -> Array:
            return run_linear(parameters, _moved(law, state, by), inputs)

        free = partial(run, parameters=parameters._replace(limit=math.inf, rate_step=math.inf))
        given = command_from_best_states(run, free, units, command, parameters.limit)
        if (error := rms(command - given)) < least:
            best, least = given, error
    return best


def first_states(law: LinearLaw, parameters: LinearParameters, state: LinearState, inputs: Array) -> Array:
    """Command (n, k) that a first offset and each first state by itself leave in the unlimited law."""
    free = parameters._replace(limit=math.inf, rate_step=math.inf)
    without = run_linear(free, state, inputs)
    units = np.eye(law.n + 1)
    return np.stack([run_linear(free, _moved(law, state, unit), inputs) - without for unit in units], axis=1)


def other_gains(
    law: Cascade | LinearLaw, tolerance: float, command: Array, inputs: Array, rate: float
) -> tuple[dict[str, float], Array]:
    """Factors on gains with which a law without limits explains a command best, and the command (n,) that they leave.

    Of a cascade with a velocity loop those of both loops and of the integral, of any other law one on everything.
    """
    running = at_rate(law, rate)
    assert running is not None
    parts = _loops(law, tolerance, inputs, rate) if isinstance(law, Cascade) and law.velocity_gain else None
    columns = parts or [_unlimited(running, tolerance, inputs)]
    states = first_states(running, _flat(running.parameters(tolerance)), _start(running, inputs), inputs)
    target, matrix = command - law.feedforward, np.column_stack([*columns, states])
    values = least_squares(matrix, target)
    left = target - matrix @ values
    if parts is None:
        return {"gain": float(values[0])}, left
    speed, *others = (float(each) for each in values[: len(parts)])
    # The integrals of both loops count once: a cascade has one factor on both.
    names = ("position_gain", "integral gain")
    ratios = {name: each / speed if speed else math.nan for name, each in zip(names, others, strict=False)}
    return {"velocity_gain": speed, **ratios}, left


def _loops(law: Cascade, tolerance: float, inputs: Array, rate: float) -> list[Array]:
    """Command of each loop by itself, (n,) each: of the speed, of the position, and the integrals of both."""

    def of(**changes: float | None) -> Array:
        return _unlimited(law.replace(sample_rate=rate, **changes).linear(), tolerance, inputs)

    speed, both = of(position_gain=0.0, integral_time=None), of(integral_time=None)
    if law.integral_time is None:
        return [speed, both - speed]
    summed = of(position_gain=0.0) - speed
    return [speed, both - speed, summed, of() - both - summed]


def _unlimited(law: LinearLaw, tolerance: float, inputs: Array) -> Array:
    """Command (n,) of a law without limits and feedforward, from rest."""
    free = law.replace(voltage_limit=None, rate_limit=None, feedforward=0.0)
    return run_linear(_flat(free.parameters(tolerance)), _start(free, inputs), inputs)


def noise_in_command(law: LinearLaw, tolerance: float, inputs: Array, spreads: Array) -> Array:
    """Command (n,) that white noise of these spreads (3,) on the inputs adds, one draw."""
    parameters = _flat(law.parameters(tolerance))._replace(limit=math.inf, rate_step=math.inf)
    start = _start(law, inputs)
    noise = spreads * np.random.default_rng(_DRAWS).normal(size=inputs.shape)
    # The dead zone does not see it: it may change sides at other moments.
    open_zone = parameters._replace(enter=-1.0, leave=-1.0)
    return run_linear(open_zone, start, inputs + noise) - run_linear(open_zone, start, inputs)


def _start(law: LinearLaw, inputs: Array) -> LinearState:
    """State of a law at rest at the first angle and position."""
    return law.start(float(inputs[0, 1]), float(inputs[0, 2]))


def _flat(parameters: LinearParameters) -> LinearParameters:
    """The parameters with arrays, which compiled code reads faster than tuples."""
    advance, output = np.array(parameters.advance), np.array(parameters.output)
    return parameters._replace(advance=cast(Sequence[float], advance), output=cast(Sequence[float], output))


def _moved(law: LinearLaw, state: LinearState, by: Array) -> LinearState:
    """The state with its offset and its states moved; spare states stay."""
    spare = (0.0,) * (len(state.states) - law.n)
    states = tuple(a + float(b) for a, b in zip(state.states, (*by[1:], *spare), strict=True))
    return state._replace(states=states, offset=state.offset + float(by[0]))


def inputs_of(window: Window, law: LinearLaw) -> Array | None:
    """Reference, motor's angle and position of a window (n, 3); None where one that the law reads was not recorded."""
    motor = window.theta_m
    if motor is None and not law.reads("y_motor"):
        motor = np.zeros(window.samples)
    channels = window.reference, motor, window.measured_position
    present = [channel for channel in channels if channel is not None]
    return np.column_stack(present) if len(present) == len(channels) else None
