"""Simulation of settings on many machines within the model's uncertainty, and the measures of each.

A controller with a sample rate is simulated as the sampled loop that runs: its own tick at its rate, delay, counts of
the sensor, limits; exact between samples. A continuous one is simulated in continuous time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from servotwin.control.retuning import friction_feedforward, integrates, rest_gain
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.members import Figures
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.redesign.certified.machines import SimulatedMachines
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation.ensemble import Cases, summarise_members
from servotwin.simulation.sampled_ensemble import SampledCases, summarise_sampled
from servotwin.simulation.to_and_fro import errors_to_and_fro

_Result = TypeVar("_Result")

NEAR = 0.02
"""Share of the step within which the loop has arrived."""
COUNTS = 2.0
"""Counts of the position sensor within which the loop may hunt: a quantised loop without friction has no rest."""

# Moves after the first one: an integral needs some until each is like the one before.
_MOVES = 3

# Half peak-to-peak of the error of a loop that has settled: shares of the step and of the lost motion. A limit cycle in
# a gap is several times as large as the lost motion; where there is hardly a gap, only the step counts.
_STILL_STEP, _STILL_GAP, _STILL_LEAST = 1e-2, 2e-2, 1e-3


@dataclass(frozen=True, eq=False)
class MachineMeasures:
    """Measures of each simulated machine, (P, C) arrays.

    Attributes
    ----------
    ripple : array
        m, half peak-to-peak of the error in the last part.
    tail : array
        m, largest abs(error) there.
    error_rms, effort : array
        m, V: root mean squares of error and voltage there.
    overshoot : array
        Largest error beyond the mean of the last part, per step and error there: the error that an input bias leaves is
        not overshoot.
    settling : array
        s, last time at which the error is beyond `nearness` of the largest step.
    cost : array
        s, integral of abs(error) over the whole run, per step.
    saturated : array of bool
        True where the voltage met the law's limit, or the command the drive's.
    still, near : array
        m, ripple and tail below which the loop has settled.
    """

    ripple: Array
    tail: Array
    error_rms: Array
    effort: Array
    overshoot: Array
    settling: Array
    cost: Array
    saturated: NDArray[np.bool_]
    still: Array
    near: Array

    @property
    def at_rest(self) -> NDArray[np.bool_]:
        """(P, C), True where the loop came to rest, wherever that is."""
        return self.ripple <= self.still

    @property
    def settled(self) -> NDArray[np.bool_]:
        """(P, C), True where the loop came to rest near its reference."""
        return self.at_rest & (self.tail <= self.near)


def joined(first: MachineMeasures, second: MachineMeasures) -> MachineMeasures:
    """Measures of machines that were simulated in two parts."""
    names = [each.name for each in fields(MachineMeasures)]
    return MachineMeasures(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def assess(
    settings: Sequence[Design], members: SimulatedMachines, trial: Trial, largest: float | None = None
) -> list[MachineMeasures]:
    """Simulate every setting on every machine, exactly; the reference steps once from rest, up or down.

    Parameters
    ----------
    settings : sequence of Design
        All continuous, or all sampled.
    members : SimulatedMachines
    trial : Trial
    largest : float, optional
        m, the step whose `nearness` counts for settling; that of these machines by default.

    Notes
    -----
    A setting with a run that changes modes without end has settled on no machine: what cannot be followed is not
    verified.
    """
    return _of_each(settings, lambda few: _assessed(few, members, trial, largest), lambda: _unsettled(members))


def _of_each(
    settings: Sequence[Design], run: Callable[[Sequence[Design]], list[_Result]], endless: Callable[[], _Result]
) -> list[_Result]:
    """Results of all settings at once; one by one where a run has no end, and `endless` for those with such a run."""
    try:
        return run(settings)
    except ZenoError:
        if len(settings) == 1:
            return [endless()]
        return [result for setting in settings for result in _of_each([setting], run, endless)]


def _assessed(
    settings: Sequence[Design], members: SimulatedMachines, trial: Trial, largest: float | None
) -> list[MachineMeasures]:
    laws, plants = _columns(settings, members)
    largest = float(members.step.max()) if largest is None else largest
    near = np.stack([nearness(setting, members, largest) for setting in settings])
    figures = _figures(laws, plants, np.array([setting.tolerance for setting in settings]), members, near, trial)
    # The voltage of a saturated machine equals its law's limit exactly, so that reaching it is what counts.
    drive = members.model.command_limit or math.inf
    limits = [min(setting.controller.voltage_limit or math.inf, drive) for setting in settings]
    still = stillness(members)
    return [
        _measures(
            _of(figures["error"], k),
            _of(figures["voltage"], k),
            members,
            trial,
            limit,
            still,
            nearness(settings[k], members, members.step),
        )
        for k, limit in enumerate(limits)
    ]


def _unsettled(members: SimulatedMachines) -> MachineMeasures:
    """Measures of machines whose runs have no end."""
    endless = np.full(members.gap.shape, math.inf)
    return MachineMeasures(
        **dict.fromkeys(("ripple", "tail", "error_rms", "effort", "overshoot", "settling", "cost"), endless),
        saturated=np.zeros(members.gap.shape, dtype=bool),
        still=stillness(members),
        near=np.zeros(members.gap.shape),
    )


def costs_to_and_fro(settings: Sequence[Design], members: SimulatedMachines, trial: Trial) -> list[Array]:
    """(P, C) s for every setting: integral of abs(error) per step of machines that move to and fro.

    A move begins where the one before ended, on the flank of the gap where the law leaves the motor. The first one
    counts in sampled loops only.

    Parameters
    ----------
    settings, members
        As for `assess`; the machines begin in the middle of their gaps.
    trial : Trial
        Its duration is that of each move.
    """
    return _of_each(settings, lambda few: _costs(few, members, trial), lambda: np.full(members.gap.shape, math.inf))


def _costs(settings: Sequence[Design], members: SimulatedMachines, trial: Trial) -> list[Array]:
    laws, plants = _columns(settings, members)
    tolerance = np.array([setting.tolerance for setting in settings])[:, None, None]
    cases = Cases(members.step, members.gap, tolerance, 0.0, members.input_bias, members.friction)
    if laws[0, 0, 0].sample_rate is None:
        sizes = errors_to_and_fro(plants, laws, trial.duration, cases, _MOVES, trial.rate, trial.threads)
        return list(sizes * trial.duration / members.step)
    sampled = SampledCases(*cases, delay=members.delay, resolution=members.model.position_resolution)
    times = trial.duration * np.arange(_MOVES + 1)
    reference = PiecewiseCubic.zero_order_hold(times, 1.0 - np.arange(_MOVES + 1) % 2)
    length = trial.duration * (_MOVES + 1)
    figures = summarise_sampled(
        plants, laws, length, sampled, trial.last, None, ("error",), trial.rate, trial.threads, reference
    )
    return list(figures["error"].mean_size * trial.duration / members.step)


def _columns(settings: Sequence[Design], members: SimulatedMachines) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    """(S, 1, 1) controllers and (P, 1) servos, which broadcast against the (P, C) conditions."""
    laws = np.empty((len(settings), 1, 1), dtype=object)
    laws[:, 0, 0] = [setting.simulated.controller for setting in settings]
    plants = np.empty((len(members.plants), 1), dtype=object)
    plants[:, 0] = members.plants
    return laws, plants


def _figures(
    laws: NDArray[np.object_],
    plants: NDArray[np.object_],
    tolerances: Array,
    members: SimulatedMachines,
    near: Array,
    trial: Trial,
) -> dict[str, Figures]:
    tolerance = tolerances[:, None, None]
    moved = members.direction * members.step
    cases = Cases(moved, members.gap, tolerance, members.theta_d0, members.input_bias, members.friction)
    outputs, limits = ("error", "voltage"), {"error": near}
    if laws[0, 0, 0].sample_rate is None:
        return summarise_members(
            plants, laws, trial.duration, cases, trial.last, limits, outputs, trial.rate, trial.threads
        )
    sampled = SampledCases(*cases, delay=members.delay, resolution=members.model.position_resolution)
    return summarise_sampled(
        plants, laws, trial.duration, sampled, trial.last, limits, outputs, trial.rate, trial.threads
    )


def stillness(members: SimulatedMachines) -> Array:
    """(P, C) m, half peak-to-peak of the error below which a loop has come to rest: by step, lost motion and sensor."""
    lost = members.model.p * members.gap
    moved = np.clip(_STILL_GAP * lost, _STILL_LEAST * members.step, _STILL_STEP * members.step)
    return np.asarray(moved + COUNTS * members.model.position_resolution)


def nearness(setting: Design, members: SimulatedMachines, step: Array | float) -> Array:
    """(P, C) m, error within which the loop has arrived, for steps (m).

    It is 2 % of the step, plus the error that input bias and friction leave where nothing integrates, plus the dead
    zone and two counts of the sensor, plus what the controller does not see of the load.
    """
    model = members.model
    seen = arrival_error(setting, model, members.input_bias, members.friction + members.own_friction, step)
    if not model.at_motor:
        return seen
    unseen = [unseen_error(plant, gap) for plant, gap in zip(members.plants, members.gap, strict=True)]
    return np.asarray(seen + np.stack(unseen))


def unseen_error(plant: Plant, gap: Array | float, factor: float = 1.0) -> Array:
    """m, largest distance at rest of the load from where the motor would have it, for gaps (rad); 0 where the
    controller reads the load.

    It is half the lost motion, and the wind-up of the shaft by what the load's friction, times a factor, and a constant
    force may hold.
    """
    if not isinstance(plant, Axis) or not plant.at_motor:
        return np.zeros_like(gap, dtype=float)
    load = plant.load
    held = factor * max(load.friction, load.static or 0.0) + abs(load.force)
    return np.asarray(0.5 * plant.p * np.asarray(gap) + held / plant.transmission.k_d)


def arrival_error(setting: Design, model: Plant, input_bias: Array, friction: Array, step: Array | float) -> Array:
    """`nearness` for input biases (V) and frictions (N m), the model's own included."""
    law = setting.controller
    # In the steady state the proportional term must supply what the feedforward leaves of the bias; friction holds the
    # motor against what it answers to the error; what is fed forward for it pushes to one side.
    held = model.command_of(friction) + abs(friction_feedforward(law))
    steady = (np.abs(input_bias + law.feedforward) + held) / rest_gain(law)
    return np.asarray(NEAR * step + steady + law.leave * setting.tolerance + COUNTS * model.position_resolution)


def steady_error(setting: Design, model: Plant, known: Uncertainty) -> float:
    """m, that input bias and friction may hold the loop off its reference; 0 with integral action."""
    law = setting.controller
    if integrates(law):
        return 0.0
    bias = max(abs(end + law.feedforward) for end in known.input_bias)
    most = known.friction[1] + known.own_friction_of(model)[1]
    held = max(0.0, float(model.command_of(most)) - abs(friction_feedforward(law)))
    return (bias + held) / rest_gain(law)


def _of(figures: Figures, setting: int) -> Figures:
    return Figures(*(values[setting] for values in figures))


def _measures(
    error: Figures,
    voltage: Figures,
    members: SimulatedMachines,
    trial: Trial,
    limit: float,
    still: Array,
    near: Array,
) -> MachineMeasures:
    """Measures from (P, C) figures."""
    step, up = members.step, members.direction > 0.0
    beyond = np.where(up, error.last_mean - error.lowest, error.highest - error.last_mean)
    return MachineMeasures(
        ripple=0.5 * (error.last_highest - error.last_lowest),
        tail=np.maximum(error.last_highest, -error.last_lowest),
        error_rms=np.sqrt(error.last_mean_square),
        effort=np.sqrt(voltage.last_mean_square),
        overshoot=np.maximum(beyond, 0.0) / (step + 2.0 * np.abs(error.last_mean)),
        settling=error.outside / trial.rate,
        cost=error.mean_size * trial.duration / step,
        saturated=np.maximum(voltage.highest, -voltage.lowest) >= limit,
        still=still,
        near=near,
    )
