"""Many continuous runs that differ in constants only: one automaton, one set of tables, all threads."""

from __future__ import annotations

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
    if law.sample_rate is not None or law.voltage_limit is not None or law.loop_filter_hz is not None:
        raise InvalidInput("an ensemble needs a continuous controller without voltage limit and loop filter")
    values = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (reference, gap, tolerance, theta_d0)))
    for name, value in zip(("gap", "tolerance"), values[1:3], strict=True):
        if not (np.isfinite(value).all() and (value >= 0.0).all()):
            raise InvalidInput(f"{name}: every value of an ensemble must be finite and 0 or more")
    loop = continuous_loop(servo, law, Shape())
    states = _starts(servo, loop, *(value.ravel() for value in values))
    modes = _modes(loop, states, law.enter)
    samples = round(duration * sample_rate) + 1
    rows = loop.rows["position"]
    out, _ = run_ensemble(loop.automaton, states, modes, 1.0 / sample_rate, samples, rows, threads)
    return out.reshape(*values[0].shape, samples)


def _starts(servo: Servo, loop: ServoAutomaton, reference: Array, gap: Array, tolerance: Array, screw: Array) -> Array:
    """(K, n) states at rest: as `plant_start` says of one."""
    index = loop.automaton.index
    states = np.array([plant_start(servo, loop, b, w) for b, w in zip(gap, screw, strict=True)])
    states[:, index("reference")], states[:, index("gap")], states[:, index("tolerance")] = reference, gap, tolerance
    return states


def _modes(loop: ServoAutomaton, states: Array, enter: float) -> NDArray[np.int64]:
    """(K,) modes: as `start_zone` says of one."""
    error = states @ loop.rows["error"][0]
    inside = np.abs(error) <= enter * states[:, loop.automaton.index("tolerance")]
    return np.where(inside, loop.mode("inside"), np.where(error > 0.0, loop.mode("+"), loop.mode("-")))
