"""Many continuous runs at once, on all threads: of one servo, or each of a servo and with a controller of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.ensemble import FigureOptions, figures_of_family, run_family
from servotwin.hybrid.members import Figures
from servotwin.plant.servo import Servo
from servotwin.simulation.cases import Cases, Crowd, crowd


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
    """Position of the last mass in many runs of one servo from rest.

    Parameters
    ----------
    servo : Servo
    duration : float
        s.
    reference, gap, tolerance, theta_d0 : array_like
        m, rad (total), m, rad: constants of each run, broadcast against each other to shape S. A tolerance of 0 is a
        dead zone of no width, a gap of 0 no backlash.
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
    members = crowd(servo, controller, Cases(reference, gap, tolerance, theta_d0))
    return _traces(members, ("position",), duration, sample_rate, threads, dead_zone=True)[:, 0].reshape(
        *members.shape, -1
    )


def simulate_members(
    servos: Any,
    controllers: Any,
    duration: float,
    reference: ArrayLike = 0.0,
    gap: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.0,
    theta_d0: ArrayLike = 0.0,
    input_bias: ArrayLike = 0.0,
    friction: ArrayLike = 0.0,
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
    reference, gap, tolerance, theta_d0, input_bias, friction : array_like
        m, rad (total), m, rad, V, N m: constants of each run. They, `servos` and `controllers` are broadcast against
        each other to shape S. A tolerance of 0 is no dead zone, a gap of 0 no backlash.
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
    members = crowd(servos, controllers, Cases(reference, gap, tolerance, theta_d0, input_bias, friction))
    traces = _traces(members, outputs, duration, sample_rate, threads)
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
    """The same runs without their samples: what each output comes to.

    Parameters
    ----------
    servos, controllers, duration, outputs, sample_rate, threads
        As for `simulate_members`.
    cases : Cases
        Its constants.
    last : float
        s, the end of a run that has figures of its own.
    limits : dict of array_like, optional
        By output, what it is outside beyond; infinite for those not named.

    Returns
    -------
    dict of Figures
        By output, arrays of shape S.

    Raises
    ------
    InvalidInput
        As `simulate_members`; also for limits of what is not asked for, or a `last` longer than the run.
    """
    members, judged = crowd(servos, controllers, cases), round(last * sample_rate)
    bounds = np.full((len(members.servos), len(outputs)), np.inf)
    for name, limit in (limits or {}).items():
        if name not in outputs:
            raise InvalidInput(f"limits name {name!r}, which is none of the outputs {', '.join(outputs)}")
        bounds[:, outputs.index(name)] = np.broadcast_to(limit, members.shape).ravel()
    found = np.empty((len(bounds), len(outputs), len(Figures._fields)))
    for group in members.groups(outputs):
        options = FigureOptions(bounds[group.which], judged)
        figures = figures_of_family(
            group.automata,
            group.rows,
            group.members,
            1.0 / sample_rate,
            _samples(duration, sample_rate),
            options,
            threads,
        )
        found[group.which] = np.stack(figures, axis=2)
    by_output = np.moveaxis(found, (1, 2), (0, 1)).reshape(len(outputs), -1, *members.shape)
    return {name: Figures(*figures) for name, figures in zip(outputs, by_output, strict=True)}


def _samples(duration: float, sample_rate: float) -> int:
    if not (0.0 < duration < np.inf and 0.0 < sample_rate < np.inf):
        raise InvalidInput(f"duration = {duration} s at sample_rate = {sample_rate} Hz: must be positive and finite")
    return round(duration * sample_rate) + 1


def _traces(
    members: Crowd,
    outputs: Sequence[str],
    duration: float,
    sample_rate: float,
    threads: int | None,
    dead_zone: bool | None = None,
) -> Array:
    """(K, O, N) outputs of all members."""
    groups, samples = members.groups(outputs, dead_zone), _samples(duration, sample_rate)
    runs = [
        run_family(group.automata, group.rows, group.members, 1.0 / sample_rate, samples, threads)[0]
        for group in groups
    ]
    if len(runs) == 1:
        return runs[0]
    found = np.empty((len(members.servos), len(outputs), samples))
    for group, run in zip(groups, runs, strict=True):
        found[group.which] = run
    return found
