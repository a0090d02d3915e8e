"""The joint fit of one window: every minimum that explains it, and the noise that is left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servotwin.estimation.core.decimation import Decimation, decimation
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.joint.knowledge import AnyPrior, known_of, start_of, tolerance_of
from servotwin.estimation.joint.model import JUMP, MOTOR_START, JointModel
from servotwin.estimation.joint.noise import noise_left
from servotwin.estimation.joint.search import Evaluate, Known, Stand, descend, scan, stand
from servotwin.estimation.joint.settings import JointSettings
from servotwin.plant.signals import Array

RIVAL, APART = 12.0, math.radians(0.3)  # a rival's cost is as near; minima closer than this (rad) are one
_GRID = np.radians([0.0, 1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0])
_STARTS = 3
_SAMPLES_HZ = 250.0  # what is kept: with fewer the noise model fits itself to the residual, spreads come out small


@dataclass(frozen=True, eq=False)
class Alone:
    """One window's fit.

    Attributes
    ----------
    model : JointModel
    known : Known
    reduce : Decimation
    noise : Autoregression
    minima : tuple of Stand
        The lowest first; whitened.
    evaluations : int
    blocked : str
        Why the window was not searched; empty when it was.
    """

    model: JointModel
    known: Known
    reduce: Decimation
    noise: Autoregression
    minima: tuple[Stand, ...]
    evaluations: int
    blocked: str = ""

    @property
    def best(self) -> Stand:
        """The lowest minimum."""
        return self.minima[0]

    def evaluated(self, known: Known) -> Evaluate:
        """Whitened residual and derivatives as a function of the point."""
        return lambda point: stand(self.model, point, known, self.whitened)

    def whitened(self, rows: Array) -> Array:
        """(k, m) reduced and whitened rows (k, n)."""
        return self.noise.whiten(self.reduce.rows(rows))


def unsearched(model: JointModel, prior: AnyPrior, settings: JointSettings, blocked: str = "") -> Alone:
    """Where a search would begin."""
    known, reduce, noise = (
        known_of(model, prior, settings),
        decimation(decimation_factor(model.rate)),
        Autoregression.white(1.0),
    )
    here = stand(model, start_of(model, prior), known, reduce.rows)
    return Alone(model, known, reduce, noise, (here,), here.evaluations, blocked)


def searched(model: JointModel, prior: AnyPrior, settings: JointSettings) -> Alone:
    """The minima of a window's cost, noise and parameters estimated in turn."""
    fit = _unwhitened(unsearched(model, prior, settings), settings)
    for number in range(settings.whitenings):
        put = number == settings.whitenings - 1
        noise = noise_left(model, fit.best, fit.reduce, fit.noise, settings.noise_order, put)
        fit = _descended(replace(fit, noise=noise), fit.known, fit.minima)
    return fit


def _unwhitened(fit: Alone, settings: JointSettings) -> Alone:
    """The minima in white noise: first with the motor's start and the jumps held, which no scan could sort out.

    Then with all of them free: what a jump that is held leaves would be taken for noise, a hundred times too much.
    """
    model, fine = fit.model, np.array([name in MOTOR_START or name.startswith(JUMP) for name in fit.model.names])
    values = dict(zip(model.names, fit.best.point.tolist(), strict=True))
    gaps = np.unique(np.append(_GRID[settings.largest_gap_rad >= _GRID], values["gap"]))
    held, tolerance = fit.known.vague(~fine), 30.0 * tolerance_of(model)
    starts = scan(model, values, gaps, _STARTS, fit.reduce.rows)
    coarse = [descend(fit.evaluated(held), begin, held, tolerance) for begin in starts]
    found = replace(fit, minima=distinct(coarse), evaluations=sum(one.evaluations for one in coarse))
    return _descended(found, fit.known.vague(fine | True), found.minima) if fine.any() else found


def _descended(fit: Alone, known: Known, starts: Sequence[Stand]) -> Alone:
    """From each of the starts to its minimum; those that are worth following."""
    tolerance = tolerance_of(fit.model)
    found = [descend(fit.evaluated(known), one.point, known, tolerance) for one in starts]
    near = min(one.cost for one in found) + 100.0 * RIVAL
    minima = tuple(one for one in distinct(found) if one.cost <= near)
    return replace(fit, minima=minima, evaluations=fit.evaluations + sum(one.evaluations for one in found))


def decimation_factor(rate: float) -> int:
    """Factor by which a window sampled at `rate` (Hz) is decimated for the fit."""
    return max(1, int(rate / _SAMPLES_HZ))


def distinct(stands: Sequence[Stand]) -> tuple[Stand, ...]:
    """The lowest of each group with the same gap, the lowest of all first."""
    kept: list[Stand] = []
    for one in sorted(stands, key=lambda one: one.cost):
        if all(abs(one.point[0] - other.point[0]) > APART for other in kept):
            kept.append(one)
    return tuple(kept)
