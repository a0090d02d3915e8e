"""Tracking of a ramp and its reversal: what a step from rest does not show of a loop with a gap."""

from __future__ import annotations

import numpy as np

from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.redesign.certified.assess import nearness, stillness
from servotwin.redesign.certified.certificate import RampResult
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty, draw
from servotwin.redesign.design import Design
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
    members = draw(servo, uncertainty, _PLANTS, 2, seed)
    law, size = setting.simulated.controller, uncertainty.step[1]
    reference = triangle(size, _RAMP * trial.unit)
    still, near = stillness(members), nearness(setting, members, members.step)
    worst, settled = 0.0, 0
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
        error = run.reference - run.position
        last = error[-max(1, round(trial.last * trial.rate)) :]
        worst = max(worst, float(np.abs(error).max()) / size)
        settled += bool(0.5 * np.ptp(last) <= still[p, c] and np.abs(last).max() <= near[p, c])
    return RampResult(members.count, settled / members.count, worst)


def triangle(size: float, time: float) -> PiecewiseCubic:
    """Reference (m) that rises to `size` within `time` (s), falls back as fast, and rests."""
    slope = size / time
    pieces = [[0.0, slope, 0.0, 0.0], [size, -slope, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
    return PiecewiseCubic(np.array([0.0, time, 2.0 * time]), np.array(pieces))
