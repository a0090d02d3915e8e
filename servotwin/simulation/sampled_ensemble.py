"""Many sampled runs at once, on all threads: each with a servo, a controller, a delay and a sensor of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotwin.control.controller import Controller
from servotwin.control.laws import Law, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.members import Figures, figures_of
from servotwin.plant.plants import Plant, prompt_plant
from servotwin.plant.signals import PiecewiseCubic, SignalLike, as_pieces
from servotwin.simulation.ensemble import Cases, check_constants, samples_of
from servotwin.simulation.inputs import RunInputs, with_forces
from servotwin.simulation.plant_block_engine import fits_plant_blocks, in_plant_blocks
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.sampled_groups import (
    GroupRun,
    SampledMembers,
    SampledSpan,
    groups_of,
    in_blocks,
    run_groups,
)
from servotwin.simulation.sampled_law import SampledLawEngine
from servotwin.simulation.sampled_members import SampledResults

LARGEST_DELAY = 64
OUTPUTS = ("error", "voltage", "position", "theta_m", "theta_d")
_CHANNELS = {"error": "position"}


class SampledCases(NamedTuple):
    """Constants of each sampled run, any shapes that broadcast.

    Attributes
    ----------
    reference, gap, tolerance, theta_d0 : array_like
        m, rad (total), m, rad. A tolerance of 0 is no dead zone, a gap of 0 no backlash.
    input_bias, friction : array_like
        V behind the controller, N m on the motor's shaft.
    delay : array_like of int
        Samples between a measurement and its voltage.
    resolution : array_like
        m, counts of the position sensor; 0 is an ideal one. It replaces the servo's own.
    """

    reference: ArrayLike = 0.0
    gap: ArrayLike = 0.0
    tolerance: ArrayLike = 0.0
    theta_d0: ArrayLike = 0.0
    input_bias: ArrayLike = 0.0
    friction: ArrayLike = 0.0
    delay: ArrayLike = 0
    resolution: ArrayLike = 0.0


def summarise_sampled(
    servos: Any,
    controllers: Any,
    duration: float,
    cases: SampledCases,
    last: float,
    limits: Mapping[str, ArrayLike] | None = None,
    outputs: Sequence[str] = ("error", "voltage"),
    sample_rate: float = 100.0,
    threads: int | None = None,
    shape: SignalLike = 1.0,
) -> dict[str, Figures]:
    """Run many sampled loops from rest, and reduce the samples of each output to figures.

    Parameters
    ----------
    servos : Servo or array_like of Servo
    controllers : Controller, Cascade or LinearLaw or array_like of them, or None
        Sampled; None: the servo's own.
    duration : float
        s.
    cases : SampledCases
        Constants of each run. They, `servos` and `controllers` are broadcast against each other to shape S.
    last : float
        s, length of the last part of a run, which has figures of its own.
    limits : dict of array_like, optional
        By output, the absolute value beyond which a sample is outside; infinite for outputs not named.
    outputs : sequence of str
        error (reference less true position, m), voltage (applied, V), position (m), theta_m, theta_d (rad).
    sample_rate : float
        Hz, of the samples that the figures are of; the rates of the controllers must divide it or be multiples.
    threads : int, optional
        As many as there are processors by default.
    shape : number or signal
        The reference over time is ``cases.reference * shape(t)``.

    Returns
    -------
    dict of Figures
        By output, arrays of shape S.

    Raises
    ------
    InvalidInput
        A controller without a sample rate or with one that does not fit, a constant out of its range, an output that
        does not exist, limits of an output that is not listed, or a `last` longer than the run.
    """
    members, span = sampled_members(servos, controllers, cases), _span(duration, sample_rate, outputs, last, shape)
    bounds = _bounds(members, limits or {}, outputs)
    values = np.empty((len(bounds), len(outputs), len(Figures._fields)))
    runs = [
        GroupRun(
            group,
            bounds[group.which],
            SampledResults(np.empty((1, len(outputs), span.samples)), np.empty((len(group.which), *values.shape[1:]))),
        )
        for group in groups_of(members, span)
    ]
    run_groups(runs, span, threads)
    for run in runs:
        values[run.group.which] = run.results.figures
    for k, traces in _ticked(members, span, threads):
        for o, trace in enumerate(traces):
            figures_of(trace, bounds[k, o], span.last, values[k, o])
    by_output = np.moveaxis(values, (1, 2), (0, 1)).reshape(len(outputs), -1, *members.shape)
    return {name: Figures(*figures) for name, figures in zip(outputs, by_output, strict=True)}


def _bounds(members: SampledMembers, limits: Mapping[str, ArrayLike], outputs: Sequence[str]) -> Array:
    """(K, O) absolute values beyond which a sample is outside."""
    bounds = np.full((len(members.servos), len(outputs)), np.inf)
    for name, limit in limits.items():
        if name not in outputs:
            raise InvalidInput(f"limits name {name!r}, which is none of the outputs {', '.join(outputs)}")
        bounds[:, outputs.index(name)] = np.broadcast_to(limit, members.shape).ravel()
    return bounds


def simulate_sampled(
    servos: Any,
    controllers: Any,
    duration: float,
    cases: SampledCases,
    outputs: Sequence[str] = ("error", "voltage"),
    sample_rate: float = 100.0,
    threads: int | None = None,
    shape: SignalLike = 1.0,
) -> dict[str, Array]:
    """Outputs of many sampled runs at every sample.

    Parameters
    ----------
    servos, controllers, duration, cases, outputs, sample_rate, threads, shape
        As for `summarise_sampled`.

    Returns
    -------
    dict of (*S, N) arrays
        By output, ``N = round(duration * sample_rate) + 1``.

    Raises
    ------
    InvalidInput
        As `summarise_sampled`.
    """
    members, span = sampled_members(servos, controllers, cases), _span(duration, sample_rate, outputs, 0.0, shape)
    traces = np.empty((len(members.servos), len(outputs), span.samples))
    none = np.empty((0, len(outputs), len(Figures._fields)))
    runs = [
        GroupRun(
            group,
            np.zeros((len(group.which), len(outputs))),
            SampledResults(np.empty((len(group.which), *traces.shape[1:])), none),
        )
        for group in groups_of(members, span)
    ]
    run_groups(runs, span, threads)
    for run in runs:
        traces[run.group.which] = run.results.traces
    for k, trace in _ticked(members, span, threads):
        traces[k] = trace
    return {name: traces[:, o].reshape(*members.shape, -1) for o, name in enumerate(outputs)}


def sampled_members(servos: Any, controllers: Any, cases: SampledCases) -> SampledMembers:
    """Broadcast servos, controllers and constants to members.

    Raises
    ------
    InvalidInput
        A controller without a sample rate, or a constant out of its range.
    """
    plants, laws = np.asarray(servos, dtype=object), np.asarray(controllers, dtype=object)
    values = [np.asarray(value, dtype=float) for value in cases]
    shape = np.broadcast_shapes(plants.shape, laws.shape, *(value.shape for value in values))
    names = SampledCases._fields
    constants = {name: np.broadcast_to(value, shape).ravel() for name, value in zip(names, values, strict=True)}
    check_constants({name: constants[name] for name in Cases._fields}, plants)
    delays, resolutions = constants["delay"], constants["resolution"]
    if not np.isin(delays, np.arange(LARGEST_DELAY + 1)).all():
        raise InvalidInput(f"delay: every value of an ensemble must be an integer of 0 to {LARGEST_DELAY} samples")
    if not (np.isfinite(resolutions).all() and resolutions.min(initial=0.0) >= 0.0):
        raise InvalidInput("resolution: every value of an ensemble must be finite and 0 m or more")
    every_servo = list(np.broadcast_to(plants, shape).ravel())
    given = np.broadcast_to(laws, shape).ravel()
    described = [servo.controller if law is None else law for servo, law in zip(every_servo, given, strict=True)]
    running = {id(law): law_of(law) for law in described}
    every_law = [running[id(law)] for law in described]
    for law in running.values():
        if law.sample_rate is None:
            raise InvalidInput("a sampled ensemble needs controllers with a sample_rate")
    every_servo, constants["delay"] = _late_in_command(every_servo, every_law, delays)
    return SampledMembers(shape, every_servo, every_law, with_forces(constants, every_servo))


def _late_in_command(servos: list[Plant], laws: list[Law], delays: Array) -> tuple[list[Plant], Array]:
    """Servos and delays with the age of what a filtered PID reads added to that of its command.

    From rest the loop then moves as it does with a late sensor, so many ticks later, and advances in blocks.
    """
    prompt = {id(servo): prompt_plant(servo) for servo in servos}
    if all(prompt[id(servo)] is servo for servo in servos):
        return servos, delays
    found, longer = list[Plant](), delays.copy()
    for k, (servo, law) in enumerate(zip(servos, laws, strict=True)):
        late = servo.sensors.fed_back(servo.p).late(law.sample_rate) if isinstance(law, Controller) else 0
        moved = 0 < late <= LARGEST_DELAY - delays[k]
        found.append(prompt[id(servo)] if moved else servo)
        longer[k] += late if moved else 0
    return found, longer


def _span(duration: float, sample_rate: float, outputs: Sequence[str], last: float, shape: SignalLike) -> SampledSpan:
    samples, last_samples = samples_of(duration, sample_rate), round(last * sample_rate)
    if last_samples > samples:
        raise InvalidInput(f"the last {last} s of a run of {duration} s: must not be longer than the run")
    for name in outputs:
        if name not in OUTPUTS:
            raise InvalidInput(f"a sampled ensemble has no output {name!r}; allowed are {', '.join(OUTPUTS)}")
    return SampledSpan(as_pieces(shape, duration), samples, sample_rate, tuple(outputs), max(last_samples, 1))


def _ticked(members: SampledMembers, span: SampledSpan, threads: int | None) -> Iterator[tuple[int, Array]]:
    """Members that do not advance in blocks, with their (O, N) outputs: the deployed law at every tick."""
    which = [k for k, blocks in enumerate(in_blocks(members, span)) if not blocks]
    if not which:
        return
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        yield from zip(which, pool.map(lambda k: _run(members, k, span), which), strict=True)


def _run(members: SampledMembers, member: int, span: SampledSpan) -> Array:
    """(O, N) outputs of one member."""
    here = {name: float(values[member]) for name, values in members.constants.items()}
    servo, tolerance = members.servos[member], here["tolerance"]
    inputs = RunInputs(
        span.shape.scaled(here["reference"]),
        PiecewiseCubic.constant(here["gap"]),
        PiecewiseCubic.constant(tolerance) if tolerance > 0.0 else None,
        span.rate,
        here["input_bias"],
        here["friction"] - servo.motor_friction,
    )
    law = members.controllers[member]
    kind = SampledLawEngine if isinstance(law, LinearLaw) else SampledEngine
    engine = kind(
        servo.with_position_resolution(here["resolution"]),
        law,  # type: ignore[arg-type]
        inputs,
        here["theta_d0"],
        span.samples,
        None,
        np.random.default_rng(0),
        delay=int(here["delay"]),
    )
    if kind is SampledEngine and fits_plant_blocks(engine):
        engine = in_plant_blocks(engine)
    engine.advance(engine.samples - 1)
    traces = {name: engine.channel(_CHANNELS.get(name, name), 0, span.samples) for name in span.outputs}
    if "error" in traces:
        traces["error"] = inputs.reference.on(inputs.times(0, span.samples)) - traces["error"]
    return np.array(list(traces.values()))
