"""Simulation of settings on many machines within the model's uncertainty, and the measures of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.members import Figures
from servotwin.redesign.certified.uncertainty import SimulatedMachines
from servotwin.redesign.design import Design
from servotwin.simulation.ensemble import Cases, summarise_members

STILL = 1e-6
"""m: half peak-to-peak of the error below which a loop counts as settled."""

NEAR = 0.02
"""Share of the largest step within which the loop has arrived."""


@dataclass(frozen=True)
class Trial:
    """Duration and sampling of the simulations.

    Parameters
    ----------
    duration, last : float
        s: length of a run from rest with one step of the reference, and of its judged last part.
    rate : float
        Hz, at which errors and voltages are sampled.
    threads : int, optional
        As many as there are processors by default.
    """

    duration: float = 60.0
    last: float = 10.0
    rate: float = 50.0
    threads: int | None = None


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
        s, last time at which the error is beyond `nearness`.
    cost : array
        s, integral of abs(error) over the whole run, per step.
    saturated : array of bool
        True where the voltage met its limit.
    """

    ripple: Array
    tail: Array
    error_rms: Array
    effort: Array
    overshoot: Array
    settling: Array
    cost: Array
    saturated: NDArray[np.bool_]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """(P, C), True where the loop settled."""
        return self.ripple < STILL


def assess(settings: Sequence[Design], members: SimulatedMachines, trial: Trial) -> list[MachineMeasures]:
    """Simulate every setting on every machine, exactly and in continuous time; the reference steps once from rest."""
    laws = np.empty((len(settings), 1, 1), dtype=object)
    laws[:, 0, 0] = [setting.continuous.controller for setting in settings]
    plants = np.empty((len(members.plants), 1), dtype=object)
    plants[:, 0] = members.plants
    tolerance = np.array([setting.tolerance for setting in settings])[:, None, None]
    figures = summarise_members(
        plants,
        laws,
        trial.duration,
        Cases(members.step, members.gap, tolerance, members.theta_d0, members.input_bias, members.friction),
        trial.last,
        {"error": np.stack([nearness(setting, members.input_bias, members.step.max()) for setting in settings])},
        ("error", "voltage"),
        trial.rate,
        trial.threads,
    )
    # The voltage of a saturated machine equals its limit exactly, so that reaching it is what counts.
    limits = [setting.controller.voltage_limit or math.inf for setting in settings]
    return [
        _measures(_of(figures["error"], k), _of(figures["voltage"], k), members.step, trial, limit)
        for k, limit in enumerate(limits)
    ]


def nearness(setting: Design, input_bias: Array, step: float) -> Array:
    """Error (m) within which the loop has arrived, for each input bias (V) and the largest step (m).

    It is 2 % of the step, plus the error that an input bias leaves where nothing integrates, plus the dead zone.
    """
    law = setting.controller
    # In the steady state the proportional term must supply what the feedforward leaves of the bias.
    steady = np.abs(input_bias + law.feedforward) / abs(law.Kp)
    return np.asarray(max(NEAR * step, STILL) + steady + law.leave * setting.tolerance)


def _of(figures: Figures, setting: int) -> Figures:
    return Figures(*(values[setting] for values in figures))


def _measures(error: Figures, voltage: Figures, step: Array, trial: Trial, limit: float) -> MachineMeasures:
    """Measures from (P, C) figures."""
    return MachineMeasures(
        ripple=0.5 * (error.last_highest - error.last_lowest),
        tail=np.maximum(error.last_highest, -error.last_lowest),
        error_rms=np.sqrt(error.last_mean_square),
        effort=np.sqrt(voltage.last_mean_square),
        overshoot=np.maximum(error.last_mean - error.lowest, 0.0) / (step + 2.0 * np.abs(error.last_mean)),
        settling=error.outside / trial.rate,
        cost=error.mean_size * trial.duration / step,
        saturated=np.maximum(voltage.highest, -voltage.lowest) >= limit,
    )
