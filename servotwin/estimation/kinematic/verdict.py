"""Verdict on a fit: status, interval and reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus, Interval
from servotwin.estimation.kinematic.bootstrap import Spread
from servotwin.estimation.kinematic.models import ModelScore
from servotwin.estimation.kinematic.regression import INERTIA, LAG, WIND_UP, Regression
from servotwin.plant.signals import Array

_DISAGREE = 2.0  # standard deviations between two weightings of the samples that a right model does not show
# Share of the gap: a smaller difference of the two weightings is covered by a wider interval, and doubts nothing. All
# 16 simulated logs that are not doubted since hold gap and lost motion; where the weightings differed by 1.4 % a
# robot's gap was 4 % off.
_ALIKE = 0.01
# Share of the gap that a model may leave of the load's motion, noise aside: beyond the first the interval covers other
# models, beyond the second nothing is said of the gap.
_LEFT, _LEFT_AT_MOST = 0.1, 0.3
# Square error of a model with wind-up by acceleration over that of the same without a gap: of two-mass drives that
# left 0.6 to 0.8 the gap was 15 to 28 % too large, of telescopes and gantries that left 0.002 it was right.
_OF_NONE = 0.5
_PIECES = 10  # of a stroke, in each of which white noise averages out
_COUNTS = 4.0
_SAID = {LAG: "a lag of the load", WIND_UP: "wind-up by the command", INERTIA: "wind-up by acceleration"}


class LagOfGap(NamedTuple):
    """The lag that does to a load what the gap does, and by how much the gap deviates for its sake.

    Attributes
    ----------
    speed : float
        Of the motor, the mean over its way, its unit per second.
    delay : float
        s, by which a load without a gap would be later.
    deviation : float
        Of the gap, the motor's unit: what the form of a lag does to the load, over the share of the flanks that no
        lag explains.
    """

    speed: float
    delay: float
    deviation: float

    def said(self, gap: float, unit: str) -> str:
        """Say that it may be there in place of a gap."""
        return (
            f"the motor moved steadily at one speed only, about {self.speed:.3g} {unit}/s: a load that is later by "
            f"{1e3 * self.delay:.3g} ms looks like {gap:.3g} {unit} of gap; record a second speed, half of it or less, "
            "or rests after moves"
        )


class KinematicFit(NamedTuple):
    """A fitted model; gaps and counts in the motor's unit.

    Attributes
    ----------
    gap, by_travel : float
        With every moment, and with every bit of the motor's way, counting alike.
    simpler : mapping
        Gaps of the simpler models that the chosen one contains, by what they leave out.
    spread : Spread
    half : float
        Half width of the 95 % interval of `gap`.
    quantisation : float
        Standard deviation of the encoders' quantisation.
    left : float
        What the model leaves of the load's motion, noise aside.
    rms : float
        The same with what seems to be noise.
    of_none : float
        Square error on unseen strokes over that of the best model without a gap.
    reach : float
        From the least to the largest lead of the motor over the load: no gap that the load takes up is larger.
    accelerated : bool
        The model has wind-up by acceleration.
    as_lag : LagOfGap or None
        None: not looked for.
    richer : tuple of float
        Gaps of richer models that predict unseen strokes better, but not by enough to be chosen.
    lead : float
        s, by which the load would be ahead of the motor, if by more than two samples; or 0.
    """

    gap: float
    by_travel: float
    simpler: Mapping[str, float]
    spread: Spread
    half: float
    quantisation: float
    left: float
    rms: float
    of_none: float
    reach: float
    accelerated: bool
    lead: float
    richer: tuple[float, ...] = ()
    as_lag: LagOfGap | None = None

    @property
    def differs(self) -> bool:
        """True where the two weightings differ by more than chance."""
        chance = math.hypot(self.spread.std_of_difference, self.quantisation)
        return abs(self.by_travel - self.gap) > _DISAGREE * chance

    @property
    def swings(self) -> bool:
        """True where the load's acceleration explains its motion nearly as well without a gap."""
        return self.accelerated and self.of_none > _OF_NONE


class KinematicVerdict(NamedTuple):
    """Status, 95 % interval and reasons."""

    status: GapStatus
    interval: Interval
    reasons: tuple[str, ...] = ()


def verdict(fit: KinematicFit, unit: str) -> KinematicVerdict:
    """Judge a fit; `unit` is the motor's."""
    # What the log does not decide the interval leaves open: a lag of half a sample in a log of few counts, for one.
    gaps = (fit.gap, *fit.richer)
    low, high = min(gaps) - fit.half, max(gaps) + fit.half
    none = low <= 0.0 or not fit.of_none < 1.0
    lag = fit.as_lag if fit.as_lag is not None and low <= _DISAGREE * fit.as_lag.deviation else None
    if fit.left > max(_LEFT_AT_MOST * fit.gap, _COUNTS * fit.quantisation):
        reason = (
            f"the load deviates by {fit.left:.3g} {unit} (rms, at the motor) from following the motor through a gap of "
            f"{fit.gap:.3g} {unit}: it swings or winds up; record a slow motion, or give the machine (--servo)"
        )
        return KinematicVerdict(GapStatus.MODEL_MISMATCH, NOTHING_KNOWN, (reason,))
    if none or lag is not None:
        # A load that hunts spoils the fit; no gap that it takes up is larger than the largest lead.
        high = max(high, 3.0 * fit.left, fit.reach, *(gap + fit.half for gap in fit.simpler.values()))
        reason = f"the gap cannot be told from none: at most {high:.3g} {unit}"
        because = () if none or lag is None else (lag.said(fit.gap, unit),)
        return KinematicVerdict(GapStatus.UNIDENTIFIABLE, (0.0, high), (*because, reason))
    reasons = _doubts(fit, unit)
    if not reasons and not fit.differs:
        return KinematicVerdict(GapStatus.OK, (max(low, 0.0), high))
    wide = _DISAGREE * fit.left
    both = (low, high, fit.by_travel - fit.half, fit.by_travel + fit.half)
    if not reasons:
        return KinematicVerdict(GapStatus.OK, (max(min(both) - wide, 0.0), max(both) + wide))
    ends = (*both, *fit.simpler.values(), *([0.0] if fit.swings or fit.lead > 0.0 else []))
    return KinematicVerdict(
        GapStatus.MODEL_MISMATCH, (max(min(ends) - wide, 0.0), max(max(ends) + wide, fit.reach)), reasons
    )


def _doubts(fit: KinematicFit, unit: str) -> tuple[str, ...]:
    """Reasons not to believe the interval."""
    reasons = []
    if fit.differs and abs(fit.by_travel - fit.gap) > _ALIKE * fit.gap:
        reasons.append(
            f"the lost motion is {fit.gap:.4g} {unit} if every moment counts alike and {fit.by_travel:.4g} {unit} "
            "if the motor's way does: the model leaves out something that is not noise"
        )
    if fit.swings:
        reasons.append(
            f"the load's acceleration explains its motion nearly as well without a gap: {100.0 * fit.of_none:.0f} % of "
            "that square error are left with one; it swings"
        )
    if fit.left > max(_LEFT * fit.gap, fit.quantisation):
        reasons.append(f"the load deviates from the model by {fit.left:.3g} {unit} (rms, at the motor), noise aside")
    if fit.rms > max(fit.gap, _COUNTS * fit.quantisation):
        # A load that hunts at a few samples a period looks like noise, and goes through its gap unseen.
        reasons.append(
            f"the load deviates by {fit.rms:.3g} {unit} (rms, at the motor) from sample to sample, more than the gap: "
            "it hunts, or the log is noisier than an encoder"
        )
    if fit.gap - fit.half > fit.reach:
        reasons.append(
            f"the motor is never further ahead of the load than {fit.reach:.4g} {unit}, less than the gap of "
            f"{fit.gap:.4g} {unit} that the model finds: the load swings"
        )
    if fit.lead > 0.0:
        reasons.append(
            f"the load would be {1e3 * fit.lead:.3g} ms ahead of the motor: its inertia drives it, or the motor's "
            "column is late; if you know that it is, shift it by so much"
        )
    for name, gap in fit.simpler.items():
        # What a swinging load does at a reversal is no proof of a gap, nor against one; a lag shows at other speeds.
        if (reasons or name != LAG) and abs(gap - fit.gap) > fit.half + 2.0 * fit.quantisation:
            reasons.append(
                f"gap and {_SAID[name]} look alike here: {fit.gap:.4g} {unit} with it, {gap:.4g} {unit} without; "
                "record the same motion at half and at a tenth of the speed"
            )
    return tuple(reasons)


def simpler(best: ModelScore, comparisons: tuple[ModelScore, ...]) -> Mapping[str, float]:
    """Gaps of the models that leave out the chosen one's lag, or its wind-up."""
    result = {}
    for name in (LAG, WIND_UP, INERTIA):
        used = tuple(each for each in best.model.used if each != name and (name, each) != (LAG, INERTIA))
        found = next((each.gap for each in comparisons[:-1] if each.model.used == used), None)
        if name in best.model.used and found is not None:
            result[name] = found
    return result


def structured(design: Regression, residual: Array) -> float:
    """Root mean square of the residual's means over pieces of the strokes, white noise taken off."""
    edges = np.unique(
        np.concatenate([np.linspace(a, b, _PIECES + 1).astype(int) for a, b in _pairs(design.bounds, residual.size)])
    )
    sizes = np.diff(edges)
    means = np.add.reduceat(residual, edges[:-1]) / sizes
    white = 0.5 * float(np.mean(np.diff(residual) ** 2)) if residual.size > 1 else 0.0
    squares = float(np.average(means**2, weights=sizes)) - white * len(sizes) / residual.size
    return math.sqrt(max(squares, 0.0))


def _pairs(bounds: Array, size: int) -> list[tuple[int, int]]:
    return list(zip(bounds, [*bounds[1:], size], strict=True))
