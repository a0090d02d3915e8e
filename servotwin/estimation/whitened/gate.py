"""Evidence for and against a fit, and the verdict: status of an estimate and the reasons for it.

Four views of a window count: the slow motion that the fit leaves (noise is fast or small, a wrong channel is neither),
the static lost motion at rest, the gap in the paper's observer form, and the gap with a free model (`shift`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.estimation.core.contacts import Travel
from servotwin.estimation.core.least_squares import spread
from servotwin.estimation.core.visible import least_travel
from servotwin.estimation.estimate import NORMAL_95, GapStatus, Interval
from servotwin.estimation.whitened.doubt import way_doubt
from servotwin.estimation.whitened.fit import AlignedFit, WhitenedFit
from servotwin.estimation.whitened.free_model import (
    COMPLIANCE,
    FREEDOM,
    ContactEvidence,
    FactorPrior,
    FreeProblem,
    contact_evidence,
)
from servotwin.estimation.whitened.lead import possible_leads
from servotwin.estimation.whitened.reduction import GAP
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.estimation.whitened.shift import ModelShift
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

# Seconds are the servo's own (`plant.scales`): `second` is how many seconds one of them has.
_SLOW_S = 0.06  # s: motions faster than this are averaged away, twice
_CHANCE = 6.0  # times what white noise would leave when averaged; decimated, it leaves twice that


def slow_share(result: WhitenedFit, second: float) -> float:
    """Slow part of the residual over the slow variation of the position, rms both; 0 where it can be noise.

    Where hardly anything moves, noise is most of the position's own variation, and that is no fault.
    """
    interval = result.reduction.response.interval * result.reduction.decimation.factor / second
    variation = float(np.std(slow(result.reduction.position, interval)))
    residual = result.residual
    remains = _rms(slow(residual, interval))
    if remains <= _CHANCE * _averaged_noise(residual, interval) and _rms(residual) <= _loudest(result):
        return 0.0
    return remains / variation if variation > 0.0 else math.inf


def _averaged_noise(values: Array, interval: float) -> float:
    """rms of the slow part of white noise that has a signal's (m,) differences from sample to sample.

    The interval here and below is in the servo's own seconds.
    """
    weights = np.convolve(_averaging(interval, values.size), _averaging(interval, values.size))
    return _rms(np.diff(values)) * math.sqrt(0.5 * float(weights @ weights))


def _loudest(result: WhitenedFit) -> float:
    """Largest residual (m rms) that can be noise: as large as the motor's whole motion, or one turn of it."""
    reduction = result.reduction
    return abs(reduction.response.static_gain) * max(float(np.ptp(reduction.theta_m)), 2.0 * math.pi)


def _averaging(interval: float, samples: int) -> Array:
    """Weights (w,) of one average, over a quarter of so many samples at most."""
    size = max(1, min(round(_SLOW_S / interval), samples // 4))
    return np.full(size, 1.0 / size)


def slow(values: Array, interval: float) -> Array:
    """A signal (m,) averaged twice."""
    window = _averaging(interval, values.size)
    return np.convolve(np.convolve(values, window, "valid"), window, "valid")


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / values.size)


_BLOCK_S = 0.1  # s, length of a block
_STILL = 0.02  # of the gap: what moves less within a block rests


def static_lost_motion(theta_m: Array, position: Array, rate: float, static_gain: float, gap: float) -> float:
    """Range (rad) of theta_m - position / static gain over the blocks in which both rest; it cannot exceed the gap.

    Parameters
    ----------
    theta_m, position : (n,) arrays
        rad, m.
    rate : float
        Samples per second of the servo's own.
    static_gain : float
        m/rad.
    gap : float
        rad, the fitted one: rest means motion below a fiftieth of it.
    """
    size = max(4, round(_BLOCK_S * rate))
    count = theta_m.size // size
    angle = theta_m[: count * size].reshape(count, size)
    load = position[: count * size].reshape(count, size) / static_gain
    allowed = _STILL * gap
    still = (np.ptp(angle, axis=1) < allowed) & (np.ptp(load, axis=1) < allowed)
    lead = (angle - load).mean(axis=1)[still]
    return float(np.ptp(lead)) if lead.size > 1 else 0.0


_SIGMAS = 3.0  # standard deviations by which another view may disagree
_LIKELIER = 45.0  # gain in likelihood above which the model is wrong: of 197 clean windows none had more than 33
_UNEXPLAINED = 0.05  # of the position's own slow variation
# The level of coloured noise rests on a few periods. What is exceeded once in 1000 windows lies at 5.4 instead of 3.3
# standard deviations when seven independent values show it (Student).
_COLOURED = 5.4 / 3.3 - 1.0
_ROUNDED = 0.4  # of a count: sqrt(2/12), as the encoder's error is not random at the two reversals that show a gap


@dataclass(frozen=True, eq=False, kw_only=True)
class FitFacts:
    """Contact, counts and noise in a fit: what costs little to compute.

    Attributes
    ----------
    aligned : AlignedFit
    travel : Travel
        Of the fitted screw.
    unexplained : float
        Slow part of the residual over that of the position.
    needed : float
        rad, least travel in each contact.
    smallest : float
        rad: a lower bound below this says nothing.
    count : float
        rad, of the encoder, as stated or as it shows in the angle; 0: none.
    scale : float
        rad, of the position's counts as they show, seen through the pitch; 0: none.
    colour : float
        Share of the noise's variance that is predicted beyond that of decimated white noise; 0: white.
    """

    aligned: AlignedFit
    travel: Travel
    unexplained: float
    needed: float
    smallest: float
    count: float = 0.0
    scale: float = 0.0
    colour: float = 0.0

    @property
    def counts(self) -> float:
        """Angle (rad) that a single contact may seem wider by, because both channels come in counts."""
        return self.count + self.scale

    @property
    def caution(self) -> float:
        """Factor on standard deviations for noise whose spectrum the window itself must show."""
        return 1.0 + _COLOURED * self.colour


@dataclass(frozen=True, eq=False, kw_only=True)
class FitEvidence(FitFacts):
    """Evidence for and against a fit.

    Attributes
    ----------
    std : float
        rad, calibrated.
    interval : (float, float)
        rad, profile likelihood.
    shift : ModelShift
        By a free model.
    observer : (float, float)
        rad: by the observer form, and the standard deviation of that.
    lost_motion : float
        rad, range of the lead at rest.
    doubt : float
        rad, root mean square of what machines and sensors that are not as assumed can do to the gap; computed for
        gaps that are accepted.
    learnt : bool
        True: the model's numbers are free in `std` already.
    """

    std: float
    interval: Interval
    shift: ModelShift
    observer: tuple[float, float]
    lost_motion: float
    doubt: float = 0.0
    learnt: bool = False

    def spread_to(self, std: float) -> FitEvidence:
        """The evidence with the spread (rad) widened, and the interval with it; as it is where that is no wider."""
        if not self.std < std < math.inf:
            return self
        gap, (low, high) = self.aligned.whitened.point.gap, self.interval
        extra = NORMAL_95 * math.sqrt(std**2 - self.std**2)
        interval = max(0.0, gap - math.hypot(gap - low, extra)), gap + math.hypot(high - gap, extra)
        return replace(self, std=std, interval=interval)


def judge(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[GapStatus, tuple[str, ...]]:
    """Decide status and reasons.

    Where the screw was not pushed far enough, the fitted gap means nothing, and other views need not agree with it.
    """
    settings = settings.of_gap(evidence.aligned.whitened.point.gap)
    too_little = one_sided(evidence.travel, evidence.needed, settings)
    disagreements = () if too_little else _disagreements(evidence, settings)
    mismatches = (*misfits(evidence, settings), *disagreements)
    silence = tuple(filter(None, (too_little, _spread(evidence, settings))))
    sure = math.isinf(evidence.interval[1]) and sure_of_contact(evidence, settings)
    bound = sure and lower_bound(evidence, settings) > evidence.smallest
    if evidence.unexplained > _UNEXPLAINED or (mismatches and not math.isinf(evidence.interval[1])):
        return GapStatus.MODEL_MISMATCH, mismatches
    if silence:
        return (GapStatus.LOWER_BOUND if bound else GapStatus.UNIDENTIFIABLE), silence
    return (GapStatus.MODEL_MISMATCH, mismatches) if mismatches else (GapStatus.OK, ())


def sure_of_contact(facts: FitFacts, settings: WhitenedSettings) -> bool:
    """False where a delay that cannot be takes the place of the motor's way to the contact."""
    aligned, rows = facts.aligned, facts.aligned.whitened.rows
    if not settings.skew or abs(aligned.delay) <= settings.skew_limit:
        return True
    std = spread(rows[-1], rows[GAP:-1]) * math.sqrt(max(1.0, aligned.whitened.variance))
    return abs(aligned.delay) <= settings.skew_limit + NORMAL_95 * std


def misfits(facts: FitFacts, settings: WhitenedSettings) -> tuple[str, ...]:
    """List what the fit leaves of the window that neither noise nor the model explains."""
    own = (_unexplained(facts), _delayed(facts, settings), _growing(facts.aligned.whitened))
    return tuple(filter(None, own))


def contacts_seen(aligned: AlignedFit, servo: Servo) -> ContactEvidence:
    """Evidence for a second contact in a window, with the model free within its usual error."""
    return contact_evidence(with_free_model(aligned, servo), aligned.whitened.misfit, aligned.whitened.point)


def with_free_model(aligned: AlignedFit, servo: Servo) -> FreeProblem:
    """Return the window in its noise with the model free within its usual error."""
    result, usual = aligned.whitened, FactorPrior.of_spreads(*FREEDOM)
    return FreeProblem(result.reduction, result.noise, servo, usual, aligned.largest, COMPLIANCE)


def least_lead(
    evidence: FitEvidence, contacts: ContactEvidence, servo: Servo, settings: WhitenedSettings, ramp: float
) -> float:
    """Lead (rad) of the motor that a window of one contact shows at least, with the model's usual error.

    Other machines and sensors, and a gap that grows by `ramp` (rad/s), may move it as far as the window tells.
    """
    problem, single, variance = with_free_model(evidence.aligned, servo), contacts.single, contacts.variance
    leads = possible_leads(problem, single, variance)
    sigmas = NORMAL_95 * evidence.caution
    doubt = way_doubt(problem, np.array([*single.point, *single.factors]), variance, evidence.aligned.delay, ramp)
    return min(lead.least(sigmas, math.hypot(settings.model_error, doubt)) for lead in leads) - evidence.counts


def lower_bound(evidence: FitEvidence, settings: WhitenedSettings) -> float:
    """Gap (rad) below which the window contradicts every gap, even with the model's usual error."""
    return max(0.0, evidence.interval[0] - NORMAL_95 * settings.model_error - evidence.counts)


def travel_needed(gap: float, servo: Servo, settings: WhitenedSettings) -> float:
    """Least travel (rad) of the screw in each contact, for a gap (rad)."""
    travel = settings.contact_travel
    return least_travel(gap, servo.encoder_resolution) if travel is None else travel


def one_sided(motion: Travel, needed: float, settings: WhitenedSettings) -> str:
    """Reason for which the contacts do not show the gap; with a known offset of the encoder one contact is enough.

    `needed` is the least travel in each, rad.
    """
    forwards, backwards = motion.forwards, motion.backwards
    enough = min(forwards, backwards) if settings.offset is None else max(forwards, backwards)
    if enough >= needed:
        return ""
    ways = "both ways" if settings.offset is None else "one way"
    return (
        f"the screw was pushed {_deg(forwards)} forwards and {_deg(backwards)} backwards, and {_deg(needed)} are "
        f"needed {ways}"
    )


def _spread(evidence: FitEvidence, settings: WhitenedSettings) -> str:
    if math.isinf(evidence.std):
        return "the measurements do not depend on the gap"
    if math.isinf(evidence.interval[1]):
        return "the window contradicts no large gap"
    gap = evidence.aligned.whitened.point.gap
    widest = max(evidence.std, (evidence.interval[1] - gap) / NORMAL_95, (gap - evidence.interval[0]) / NORMAL_95)
    widest *= evidence.caution
    if widest > settings.largest_std:
        return f"the gap is known to {_deg(widest)} only, and {_deg(settings.largest_std)} are allowed"
    rounded = math.hypot(widest, _ROUNDED * evidence.count)
    if rounded > settings.largest_std:
        return (
            f"the gap is known to {_deg(rounded)} only with counts of {_deg(evidence.count)}, and "
            f"{_deg(settings.largest_std)} are allowed"
        )
    return ""


def _unexplained(facts: FitFacts) -> str:
    if facts.unexplained <= _UNEXPLAINED:
        return ""
    return f"the model leaves {100.0 * facts.unexplained:.0f} % of the position's slow motion unexplained"


def _delayed(facts: FitFacts, settings: WhitenedSettings) -> str:
    delay = facts.aligned.delay
    if abs(delay) <= settings.skew_limit:
        return ""
    allowed = 1e3 * settings.skew_limit
    return f"position and theta_m would be {1e3 * delay:+.3g} ms apart, and {allowed:.3g} ms are allowed"


def _growing(result: WhitenedFit) -> str:
    """Reason against a window in which the gap grows faster than is assumed; empty where it does not."""
    reduction = result.reduction
    if reduction.growth is None:
        return ""
    excess = float(result.shares[len(reduction.fixed())])
    rate, assumed = reduction.rate + excess, _SIGMAS * reduction.growth.std
    if abs(rate) <= assumed:
        return ""
    per_s = 1.0 / reduction.response.interval
    return f"the gap would grow by {_deg(rate * per_s)}/s within the window, and {_deg(assumed * per_s)}/s are assumed"


def _disagreements(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[str, ...]:
    """List the disagreements of other views of the same window with the fit."""
    sentences = []
    shift, limit = evidence.shift, settings.largest_shift
    if abs(shift.gap) > max(limit, NORMAL_95 * shift.std) and shift.gain > _LIKELIER:
        sentences.append(f"with the model free the gap would move by {_deg(shift.gap)}: {shift.words}")
    if shift.gain > _LIKELIER and _spread(evidence, settings):
        sentences.append(f"freeing the model makes the window far likelier: {shift.words}")
    move, std = evidence.observer
    if abs(move) > max(2.0 * limit, _SIGMAS * std):
        sentences.append(f"the observer form puts the gap {_deg(move)} away, with a joint spread of {_deg(std)}")
    gap = evidence.aligned.whitened.point.gap
    if evidence.lost_motion > 1.05 * gap + _SIGMAS * evidence.std + evidence.needed:
        sentences.append(
            f"the lost motion at rest is {_deg(evidence.lost_motion)}, more than the fitted gap of {_deg(gap)}"
        )
    return tuple(sentences)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.3g} deg"
