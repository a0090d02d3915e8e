"""Stability maps: an ensemble of initial states in every cell, each run exact, reduced to measures."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from servotwin.analysis.limit_cycles.scaled import characteristic_time
from servotwin.analysis.maps.axes import Cells
from servotwin.analysis.maps.settings import MapSettings
from servotwin.control.controller import Controller
from servotwin.control.laws import Law
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.ensemble import run_ensemble
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.automaton import ServoAutomaton, Shape, continuous_loop
from servotwin.plant.linear_zones import law_state, linear_loop
from servotwin.simulation.continuous import controller_constants
from servotwin.simulation.ensemble_starts import start_modes
from servotwin.simulation.inputs import plant_forces

# Half-width about the final position, per reference step: the usual five per cent.
SETTLING_BAND = 0.05


@dataclass(frozen=True, eq=False)
class Measures:
    """Measures of the members of each cell, (N,) each.

    Attributes
    ----------
    settled : array
        Share of the members whose half peak-to-peak in the final window is below `MapSettings.stillness`.
    settled_short : array
        The same of the last ten seconds of the servo's own only (of the final window, if that is shorter). Where it is
        larger, there are members that rest and move on.
    error : array
        m, largest absolute error of any member in the final window: the steady error of those that settled.
    swing : array
        m, largest half peak-to-peak in the final window.
    settling : array
        s, the latest time from which a member's position stays within 5 % of the step about its mean in the final
        window; inf where one does not through all of that window.
    effort : array
        V, root mean square of the voltage over all members and the whole run.
    """

    settled: Array
    settled_short: Array
    error: Array
    swing: Array
    settling: Array
    effort: Array


MEASURES = tuple(field.name for field in fields(Measures))


def measured(settings: MapSettings, chunk: range) -> Measures:
    """Run all members of some cells in this thread; how cells are grouped does not change their numbers."""
    cells = Cells(*(values[chunk.start : chunk.stop] for values in settings.axes.cells(settings.servo)))
    position, voltage = trajectories(settings, cells, chunk)
    with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
        return _reduced(settings, cells.amplitude[:, None, None], position, voltage)


def compute_cells(settings: MapSettings, threads: int | None = None) -> Measures:
    """Run all cells of a map in threads of this process, by default as many as there are processors."""
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return joined(list(pool.map(partial(measured, settings), settings.chunks)))


def joined(parts: list[Measures]) -> Measures:
    """Join the measures of cells that follow one another."""
    return Measures(*(np.concatenate([getattr(part, name) for part in parts]) for name in MEASURES))


def trajectories(settings: MapSettings, cells: Cells, chunk: range) -> tuple[Array, Array]:
    """Position (m) and voltage (V), each (cells, members, samples)."""
    loop = automaton(settings)
    states = starts(settings, loop, cells, chunk).reshape(-1, len(loop.automaton.names))
    modes, rows = start_modes(loop, states, settings.law.enter), np.array([loop.rows["position"], loop.rows["voltage"]])
    try:
        traces, _ = run_ensemble(
            loop.automaton, states, modes, 1.0 / settings.sample_rate, settings.samples, rows, threads=1
        )
    except ZenoError as error:
        raise InvalidInput(f"map cells {chunk.start} to {chunk.stop - 1}: {error}") from None
    position, voltage = np.moveaxis(traces.reshape(len(chunk), settings.members, 2, -1), 2, 0)
    return position, voltage


def automaton(settings: MapSettings) -> ServoAutomaton:
    """Plant and law together, with a dead zone."""
    law = settings.law
    shape = Shape(feedforward=law.feedforward != 0.0, friction=settings.servo.motor_friction != 0.0)
    if isinstance(law, LinearLaw):
        return linear_loop(settings.servo, law, shape)
    return continuous_loop(settings.servo, law, shape)


def starts(settings: MapSettings, loop: ServoAutomaton, cells: Cells, chunk: range) -> Array:
    """(cells, members, n) initial states."""
    servo, index = settings.servo, loop.automaton.index
    draws = np.array([_draws(settings, cell) for cell in chunk])
    step, omega = cells.amplitude[:, None], 2.0 * math.pi / characteristic_time(servo, settings.law)
    states = np.zeros((*draws.shape[:2], len(loop.automaton.names)))
    screw = 0.5 * cells.gap[:, None] * draws[:, :, 0]
    angle, rest = servo.at_rest(1.0)
    states[:, :, index("theta_d")] = angle * screw
    states[:, :, index("theta_d") + 1 : index("theta_d") + 1 + rest.size] = screw[:, :, None] * rest
    states[:, :, index("speed")] = settings.motion * draws[:, :, 1] * step * omega / servo.p
    for name, value in zip(("gap", "tolerance", "reference"), cells, strict=True):
        states[:, :, index(name)] = value[:, None]
    for name, constant in controller_constants(settings.law).items():
        if name in loop.automaton.names:
            states[:, :, index(name)] = constant
    for name, force in plant_forces(servo).items():
        if name in loop.automaton.names:
            states[:, :, index(name)] = force
    moved = settings.motion * draws[:, :, 2] * step / omega
    _set_law(settings.law, loop, states, moved)
    return states


def _set_law(law: Law, loop: ServoAutomaton, states: Array, moved: Array) -> None:
    """Set the law's states: at rest at the measurements, its integral action away from it by `moved` (m s of error)."""
    index = loop.automaton.index
    sensed = states @ loop.rows["sensed"][0]
    if isinstance(law, Controller):
        states[:, :, index("integral")] = moved * law.Ki
        if law.loop_filter_hz is not None:
            states[:, :, index("filtered")] = sensed
        return
    # At rest with no error, and the motor at zero: proportional to the load's position.
    resting = law.rest((law.error[1], 0.0, 1.0), dict.fromkeys(law.holds, 0.0))
    for name, value, row in zip(law.names, resting, law.B, strict=True):
        states[:, :, index(law_state(name))] = row[0] * moved if name in law.holds else value * sensed


def _draws(settings: MapSettings, cell: int) -> Array:
    """(members, 3) in -1 .. 1: screw in the gap, motor speed, integral."""
    # What SeedSequence(seed).spawn(...)[cell] would be: a cell's numbers do not depend on which others are computed.
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(cell,)))
    draws = rng.uniform(-1.0, 1.0, (settings.members, 3))
    # The first member starts as the paper does, in the middle of the gap; every second of the others is at rest too.
    draws[0] = 0.0
    draws[1::2, 1:] = 0.0
    return draws


def _reduced(settings: MapSettings, step: Array, position: Array, voltage: Array) -> Measures:
    """Measures of trajectories (cells, members, samples); `step` is (cells, 1, 1)."""
    tail = _tail(position, settings.last_part * settings.sample_rate)
    short = _tail(tail, settings.short_part * settings.sample_rate)
    swing, swing_short = (0.5 * np.ptp(each, axis=2) for each in (tail, short))
    inside = np.abs(position - tail.mean(axis=2, keepdims=True)) <= SETTLING_BAND * step
    since = _since(inside) / settings.sample_rate
    settling = np.where(since <= settings.run_time - settings.last_part, since, np.inf)
    return Measures(
        np.mean(swing < settings.stillness, axis=1),
        np.mean(swing_short < settings.stillness, axis=1),
        np.abs(step - tail).max(axis=(1, 2)),
        swing.max(axis=1),
        settling.max(axis=1),
        np.sqrt(np.mean(voltage**2, axis=(1, 2))),
    )


def _tail(values: Array, samples: float) -> Array:
    return values[:, :, -(round(samples) + 1) :]


def _since(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Index along the last axis from which on all is True; its length where the last one is not."""
    count = inside.shape[-1]
    return np.where(inside.all(axis=-1), 0, count - np.argmin(inside[..., ::-1], axis=-1))
