"""Many continuous runs that differ in constants only: one automaton, one set of tables, all threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.ensemble import run_ensemble
from servotwin.plant.automaton import Shape, continuous_loop
from servotwin.plant.servo import Servo
from servotwin.simulation.continuous import plant_start, start_zone


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
    index = {name: loop.automaton.index(name) for name in ("reference", "gap", "tolerance")}
    states, modes = [], []
    for r, b, tol, screw in zip(*(value.ravel().tolist() for value in values), strict=True):
        state = plant_start(servo, loop, b, screw)
        state[index["reference"]], state[index["gap"]], state[index["tolerance"]] = r, b, tol
        modes.append(loop.mode(start_zone(float(loop.rows["error"][0] @ state), law.enter * tol)))
        states.append(state)
    samples = round(duration * sample_rate) + 1
    rows = loop.rows["position"]
    out, _ = run_ensemble(loop.automaton, states, modes, 1.0 / sample_rate, samples, rows, threads)
    return out.reshape(*values[0].shape, samples)
