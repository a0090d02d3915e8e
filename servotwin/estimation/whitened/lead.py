"""Least lead of the motor over the screw with which a single contact explains a window: what the gap is at least.

The lead is as wide as the motor's way to the contact, which shows in when and how abruptly the load begins to follow.
A machine that differs from its model moves it, and a soft screw does so most: it delays the load, and takes a part of
the travel. How soft the screw is enters far from linearly (its first mass rings), so that several softnesses are tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import travel
from servotwin.estimation.whitened.free_model import BELIEVED, HOPELESS, FreeFit, FreeProblem, other_screws
from servotwin.estimation.whitened.nearby import PITCH, own_softness

# Structure's stiffness over the screw's, beyond that of the model. Below the first the lead moves by little, and a
# screw softer than the last is no drive.
_SOFTER = (0.0, 0.02, 0.05, 0.1, 0.2)
_EXCLUDED = 30.0  # rise of the cost over the variance: 5.5 standard deviations
_GAIN = 0.1  # of the variance: a third of one standard deviation


class Lead(NamedTuple):
    """Range by which the motor leads the screw, and its standard deviation with the model free; rad."""

    angle: float
    std: float

    def least(self, sigmas: float, systematic: float) -> float:
        """Lead (rad) less so many standard deviations, a systematic one (rad) included."""
        return self.angle - sigmas * math.hypot(systematic, self.std)


def possible_leads(problem: FreeProblem, single: FreeFit, variance: float) -> list[Lead]:
    """Leads in the fits of one contact, for each softness of the screw and each begin that explain the window nearly as
    well.

    Parameters
    ----------
    problem : FreeProblem
        Of the window; its compliance is not used.
    single : FreeFit
        A fit of one contact.
    variance : float
        Of the residual in units of the noise, at least 1.
    """
    allowed = BELIEVED * variance
    fits, begun = list(_softer(problem, single, allowed)), _begun_in_contact(problem, single)
    least = min(fit.cost for fit in (*fits, *begun))
    possible = [fit for fit in fits if fit.cost <= least + allowed]
    possible += [fit for fit in begun if fit.cost <= least + _EXCLUDED * variance]
    # Without noise none of a few screws explains the window as well as the true one, which lies between them.
    start = np.array([*single.point, *single.factors])
    possible += other_screws(replace(problem, compliance=0.0), start, (False, True), _GAIN)
    return [_lead(problem, fit, variance) for fit in possible]


def _softer(problem: FreeProblem, single: FreeFit, allowed: float) -> Iterator[FreeFit]:
    """Fits with softer and softer screws, each from the one before, until the cost has risen by what is allowed."""
    servo, least = problem.servo, math.inf
    stiffness = float(servo.stiffnesses.max())
    own = own_softness(servo)
    # The structure is held at its other end too: a soft screw takes its share of the travel.
    before, here, moved = 0.0, np.array([*single.point, *single.factors]), np.eye(6)[2 + PITCH]
    for more in _SOFTER:
        screw = stiffness / (own + more) if own + more > 0.0 else math.inf
        softened = replace(problem, servo=servo.replace(k_d=screw), compliance=0.0)
        start = here + (more - before) * moved
        within = (0.0, least + allowed, least + HOPELESS * allowed)
        fit = softened.descend(start, (False, True), within, gain=_GAIN)
        yield fit
        least = min(least, fit.cost)
        if fit.cost > least + allowed:
            return
        there = np.array([*fit.point, *fit.factors])
        moved = (there - here) / (more - before) if before > 0.0 else moved
        before, here = more, there


def _begun_in_contact(problem: FreeProblem, single: FreeFit) -> list[FreeFit]:
    """Fits in which the motor touches the screw from the first sample on, on either side.

    In a window that begins after the contact, free motions and the machine's own error take the place of a way to it.
    """
    stiff = replace(problem, compliance=0.0)
    starts = [np.array([single.point.gap, side, *single.factors]) for side in (-1.0, 1.0)]
    return [stiff.descend(start, (False, True), gain=_GAIN) for start in starts]


def _lead(problem: FreeProblem, fit: FreeFit, variance: float) -> Lead:
    theta_m = problem.reduction.theta_m
    motion = travel(theta_m, fit.point.screw(theta_m[0]))
    # The way to the contact is what the place says: half the gap per unit.
    moved = motion.forwards + motion.backwards > 0.0
    std = 0.5 * fit.point.gap * math.sqrt(variance * fit.covariance[1, 1]) if moved else 0.0
    return Lead(motion.lead, std)
