"""Many continuous runs at once: members that differ in constants share one automaton and its tables, members that
differ in servo or controller are run side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.ensemble import run_ensemble
from servotwin.plant.automaton import ServoAutomaton, Shape, continuous_loop
from servotwin.plant.servo import Servo
from servotwin.simulation.continuous import plant_start


def simulate_ensemble(
    servo: Servo,
    duration: float,
    reference: ArrayLike = 0.0,
    gap: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.0,
    theta_d0: ArrayLike = 0.0,
    controller: Controller | None = None,
    sample_rate: float = 100.0,
    threads: int | None = None,
) -> Array:
    """Position of the last mass in many runs from rest.

    Parameters
    ----------
    servo : Servo
    duration : float
        s.
    reference, gap, tolerance, theta_d0 : array_like
        m, rad (total), m, rad: constants of each run, broadcast against each other to shape S. A tolerance of 0 is no
        dead zone, a gap of 0 no backlash.
    controller : Controller, optional
        Continuous; the servo's own by default.
    sample_rate : float
        Hz, of the output; events are searched for on a step of their own.
    threads : int, optional
        As many as there are processors by default.

    Returns
    -------
    (*S, N) array
        m, ``N = round(duration * sample_rate) + 1``.
    """
    law = servo.controller if controller is None else controller
    constants = _constants(reference, gap, tolerance, theta_d0)
    out = _run_shared(servo, law, Shape(), constants, duration, sample_rate, ("position",), threads)
    return out.reshape(*np.broadcast_shapes(*map(np.shape, (reference, gap, tolerance, theta_d0))), out.shape[-1])


def simulate_members(
    servos: Servo | Sequence[Any] | NDArray[np.object_],
    controllers: Controller | Sequence[Any] | NDArray[np.object_] | None,
    duration: float,
    reference: ArrayLike = 0.0,
    gap: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.0,
    theta_d0: ArrayLike = 0.0,
    outputs: Sequence[str] = ("error", "voltage"),
    sample_rate: float = 100.0,
    threads: int | None = None,
) -> dict[str, Array]:
    """Several outputs of many runs from rest, each with a servo and a controller of its own.

    Parameters
    ----------
    servos : Servo or array_like of Servo
    controllers : Controller or array_like of Controller, optional
        Continuous; None: each servo's own.
    duration : float
        s.
    reference, gap, tolerance, theta_d0 : array_like
        m, rad (total), m, rad: constants of each run. They, `servos` and `controllers` are broadcast against each other
        to shape S. A tolerance of 0 is no dead zone, a gap of 0 no backlash.
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
    """
    plants, laws = _objects(servos), _objects(controllers)
    constants = [np.asarray(v, dtype=float) for v in (reference, gap, tolerance, theta_d0)]
    shape = np.broadcast_shapes(plants.shape, laws.shape, *(v.shape for v in constants))
    flat = _constants(*(np.broadcast_to(v, shape) for v in constants))
    groups: dict[tuple[Servo, Controller, bool], list[int]] = {}
    pairs = zip(np.broadcast_to(plants, shape).ravel(), np.broadcast_to(laws, shape).ravel(), flat[2], strict=True)
    for member, (servo, law, width) in enumerate(pairs):
        groups.setdefault((servo, servo.controller if law is None else law, width > 0.0), []).append(member)
    out = np.empty((len(flat[0]), len(outputs), round(duration * sample_rate) + 1))
    for (servo, law, dead_zone), members in groups.items():
        chosen = [v[members] for v in flat]
        kind = Shape(dead_zone=dead_zone)
        out[members] = _run_shared(servo, law, kind, chosen, duration, sample_rate, outputs, threads)
    return {name: out[:, i].reshape(*shape, -1) for i, name in enumerate(outputs)}


def _objects(values: object) -> NDArray[np.object_]:
    return np.asarray(values, dtype=object)


def _constants(reference: ArrayLike, gap: ArrayLike, tolerance: ArrayLike, theta_d0: ArrayLike) -> list[Array]:
    """(K,) of each, checked."""
    values = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (reference, gap, tolerance, theta_d0)))
    for name, value in zip(("gap", "tolerance"), values[1:3], strict=True):
        if not (np.isfinite(value).all() and (value >= 0.0).all()):
            raise InvalidInput(f"{name}: every value of an ensemble must be finite and 0 or more")
    return [value.ravel() for value in values]


def _run_shared(
    servo: Servo,
    law: Controller,
    shape: Shape,
    constants: Sequence[Array],
    duration: float,
    sample_rate: float,
    outputs: Sequence[str],
    threads: int | None,
) -> Array:
    """(K, O, N) outputs of members of one servo and controller."""
    if law.sample_rate is not None or law.voltage_limit is not None or law.loop_filter_hz is not None:
        raise InvalidInput("an ensemble needs a continuous controller without voltage limit and loop filter")
    loop = continuous_loop(servo, law, shape)
    states = _starts(servo, loop, *constants)
    modes = _modes(loop, states, law.enter)
    samples = round(duration * sample_rate) + 1
    rows = np.array([loop.rows[name] for name in outputs])
    return run_ensemble(loop.automaton, states, modes, 1.0 / sample_rate, samples, rows, threads)[0]


def _starts(servo: Servo, loop: ServoAutomaton, reference: Array, gap: Array, tolerance: Array, screw: Array) -> Array:
    """(K, n) states at rest: as `plant_start` says of one."""
    index = loop.automaton.index
    states = np.array([plant_start(servo, loop, b, w) for b, w in zip(gap, screw, strict=True)])
    states[:, index("reference")], states[:, index("gap")], states[:, index("tolerance")] = reference, gap, tolerance
    return states


def _modes(loop: ServoAutomaton, states: Array, enter: float) -> NDArray[np.int64]:
    """(K,) modes: as `start_zone` says of one."""
    if "inside" not in loop.zones:
        return np.full(len(states), loop.mode("on"))
    error = states @ loop.rows["error"][0]
    inside = np.abs(error) <= enter * states[:, loop.automaton.index("tolerance")]
    return np.where(inside, loop.mode("inside"), np.where(error > 0.0, loop.mode("+"), loop.mode("-")))
