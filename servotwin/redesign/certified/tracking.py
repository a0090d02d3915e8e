"""Tracking of a ramp and its reversal: what a step from rest does not show of a loop with a gap."""

from __future__ import annotations

import math

import numpy as np

from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array, PiecewiseCubic
from servotwin.redesign.certified.assess import nearness, stillness
from servotwin.redesign.certified.certificate import RampResult
from servotwin.redesign.certified.machines import SimulatedMachines, draw
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation.ensemble import samples_of
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled
from servotwin.simulation.simulate import simulate

# Length of a ramp in units of 1 / crossover: several times what the loop lags behind.
_RAMP = 12.0
_PLANTS = 2


def follow_ramp(servo: Plant, uncertainty: Uncertainty, setting: Design, trial: Trial, seed: int) -> RampResult:
    """Simulate a ramp to the largest step, its reversal, and the stop where it began.

    It runs on the model and on a drawn plant, each with the largest and the smallest gap.

    Parameters
    ----------
    servo, uncertainty, setting, trial
        As for the verification.
    seed : int
    """
    members, size = draw(servo, uncertainty, _PLANTS, 2, seed), uncertainty.step[1]
    still, near = stillness(members), nearness(setting, members, members.step)
    try:
        errors = _errors(setting, members, trial, triangle(size, _RAMP * trial.unit))
    except ZenoError:
        # What cannot be followed is not verified.
        return RampResult(members.count, 0.0, math.inf)
    last = errors[..., -max(1, round(trial.last * trial.rate)) :]
    settled = (0.5 * np.ptp(last, axis=-1) <= still) & (np.abs(last).max(axis=-1) <= near)
    return RampResult(members.count, float(np.mean(settled)), float(np.abs(errors).max()) / size)


def _errors(setting: Design, members: SimulatedMachines, trial: Trial, reference: PiecewiseCubic) -> Array:
    """(P, C, N) m, reference less position of every machine."""
    law = setting.simulated.controller
    if law.sample_rate is not None:
        cases = SampledCases(
            1.0,
            members.gap,
            setting.tolerance,
            members.theta_d0,
            members.input_bias,
            members.friction,
            resolution=members.model.position_resolution,
        )
        plants = np.array(members.plants, dtype=object)[:, None]
        runs = simulate_sampled(
            plants, law, trial.duration, cases, ("error",), trial.rate, trial.threads, shape=reference
        )
        return runs["error"]
    errors = np.empty((*members.gap.shape, samples_of(trial.duration, trial.rate)))
    for p, c in np.ndindex(members.gap.shape):
        run = simulate(
            members.plants[p],
            trial.duration,
            controller=law,
            reference=reference,
            gap=float(members.gap[p, c]),
            tolerance=setting.tolerance or None,
            theta_d0=float(members.theta_d0[p, c]),
            sample_rate=trial.rate,
            input_bias=float(members.input_bias[p, c]),
            friction=float(members.friction[p, c]),
        )
        errors[p, c] = run.reference - run.position
    return errors


def triangle(size: float, time: float) -> PiecewiseCubic:
    """Reference (m) that rises to `size` within `time` (s), falls back as fast, and rests."""
    slope = size / time
    pieces = [[0.0, slope, 0.0, 0.0], [size, -slope, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
    return PiecewiseCubic(np.array([0.0, time, 2.0 * time]), np.array(pieces))
