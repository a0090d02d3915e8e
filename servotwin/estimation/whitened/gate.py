"""Evidence for and against a fit, and the verdict: status of an estimate and the reasons for it.

Four views of a window count: the slow motion that the fit leaves (noise is fast or small, a wrong channel is neither),
the static lost motion at rest, the gap in the paper's observer form, and the gap with a free model. Near the fit, a
model that is a little off adds multiples of a few known motions to the position: those of a stiffer or more damped
structure, of another pitch or scale, of a compliant screw. Free within wide tolerances, they take what they can of the
residual, and the gap moves with them. So does a gap that grows within the window, where it counts as constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import BY_RATE, Travel
from servotwin.estimation.core.least_squares import LeastSquares, least_squares, orthonormal, project_out, spread
from servotwin.estimation.core.reduced import ReducedResponse
from servotwin.estimation.core.variants import variants
from servotwin.estimation.core.visible import least_travel
from servotwin.estimation.core.whitening import burg
from servotwin.estimation.estimate import NORMAL_95, GapStatus, Interval
from servotwin.estimation.paper.observer import LagFilter, observer
from servotwin.estimation.whitened.fit import AlignedFit, WhitenedFit
from servotwin.estimation.whitened.free_model import (
    COMPLIANCE,
    FREEDOM,
    ContactEvidence,
    FactorPrior,
    FreeProblem,
    contact_evidence,
)
from servotwin.estimation.whitened.nearby import Neighbour, motions
from servotwin.estimation.whitened.reduction import CONSTANT, GAP, PLACE, RESIDUAL
from servotwin.estimation.whitened.settings import WhitenedSettings
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
    left = result.left
    remains = _rms(slow(left, interval))
    if remains <= _CHANCE * _averaged_noise(left, interval) and _rms(left) <= _loudest(result):
        return 0.0
    return remains / variation if variation > 0.0 else math.inf


def _averaged_noise(values: Array, interval: float) -> float:
    """rms of the slow part of white noise that has a signal's (m,) differences from sample to sample.

    The interval here and below is in the servo's own seconds.
    """
    weights = np.convolve(_averaging(interval), _averaging(interval))
    return _rms(np.diff(values)) * math.sqrt(0.5 * float(weights @ weights))


def _loudest(result: WhitenedFit) -> float:
    """Largest residual (m rms) that can be noise: as large as the motor's whole motion, or one turn of it."""
    reduction = result.reduction
    return abs(reduction.response.static_gain) * max(float(np.ptp(reduction.theta_m)), 2.0 * math.pi)


def _averaging(interval: float) -> Array:
    """Weights (w,) of one average."""
    size = max(1, round(_SLOW_S / interval))
    return np.full(size, 1.0 / size)


def slow(values: Array, interval: float) -> Array:
    """A signal (m,) averaged twice."""
    window = _averaging(interval)
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


_STEP = 1e-3  # relative
_STIFF = 100.0  # screw over structure: far enough for the motion to be linear in the compliance
_TOLERANCES = {"stiffness": 0.1, "damping": 0.5, "pitch or position scale": 0.05, "screw compliance": 0.1}
_GROWTH = math.radians(0.15)  # rad/s: the paper's wear at its fastest
_ALPHA = 40.0  # rad/s, the paper's observer


class ModelShift(NamedTuple):
    """Change of the gap (rad) with the model free, its standard deviation, its main cause in words, and the gain.

    The gain is twice the logarithm of the likelihood ratio: a few for a right model.
    """

    gap: float
    std: float
    words: str
    gain: float


def model_shift(result: WhitenedFit, servo: Servo, order: int, second: float) -> ModelShift:
    """Move of the gap when the model is free within `_TOLERANCES`, in the noise that is then left.

    Whitening takes the error of a wrong model for noise; a free model takes it up itself.
    """
    model, reduction = result.reduction.reduced, result.reduction
    screw = reduction.traced(result.point)
    table, weights = result.table, result.shares[1 : len(reduction.fixed())]
    answer = reduction.position - table[RESIDUAL]
    moved = motions(model, _neighbours(servo, model), screw[:1], answer, weights)
    free = np.insert(moved, 2, answer, axis=0)
    sizes = list(_TOLERANCES.values())
    if reduction.growth is None:
        free = np.vstack([free, model.respond(screw[BY_RATE:])])
        sizes.append(_GROWTH / second * model.response.interval)
    free *= np.array(sizes)[:, None]
    table, size = np.vstack([table, free]), len(free)
    shares = _within_tolerance(reduction.prepared(result.noise, table, CONSTANT), size).coefficients
    noise = burg((table[RESIDUAL] - shares @ table[GAP:])[None], order).at_least(reduction.rounding)
    rows = reduction.prepared(noise, table, CONSTANT)
    solved = _within_tolerance(rows, size)
    own = spread(rows[GAP], rows[PLACE:-size])
    std = math.sqrt(max(0.0, float(solved.deviations[0]) ** 2 - own**2)) if math.isfinite(own) else math.inf
    words = _words(solved.coefficients[-size:], solved.deviations[-size:], second)
    gain = (
        2.0 * table.shape[1] * math.log(result.noise.spread[-1] / noise.spread[-1]) if noise.spread[-1] > 0.0 else 0.0
    )
    return ModelShift(float(solved.coefficients[0]), std, words, gain)


def _within_tolerance(rows: Array, free: int) -> LeastSquares:
    """Solve for all coefficients; the last `free` ones are expected to be 0 with standard deviation 1."""
    known = np.zeros((len(rows), free))
    known[-free:] = np.eye(free)
    columns = np.hstack([rows, known])
    return least_squares(columns[GAP:], columns[RESIDUAL])


def _words(shares: Array, deviations: Array, second: float) -> str:
    """Describe the direction that is needed most, and its size."""
    index = int(np.argmax(np.abs(shares) / np.maximum(deviations, 1e-9)))
    if index == len(_TOLERANCES):
        return (
            f"a gap that grows by {math.degrees(_GROWTH / second) * shares[index]:+.2g} deg/s would explain most of it"
        )
    name = list(_TOLERANCES)[index]
    return f"a {name} off by {100.0 * _TOLERANCES[name] * shares[index]:+.2g} % would explain most of it"


@lru_cache(maxsize=32)
def _neighbours(servo: Servo, model: ReducedResponse) -> tuple[Neighbour, ...]:
    """Neighbours of a servo's response in stiffness, damping and the screw's compliance (of the structure's)."""
    rate, stiffness = 1.0 / model.response.interval, float(servo.stiffnesses.max())
    own = 0.0 if servo.rigid else stiffness / servo.k_d
    soft = 1.0 / _STIFF if servo.rigid else own * (1.0 + _STEP)
    stiffer, damped = variants(servo, list(math.log1p(_STEP) * np.eye(4)[:2]), rate)
    (softer,) = variants(servo, [np.zeros(4)], rate, [stiffness / soft])
    steps = ((stiffer, _STEP), (damped, _STEP), (softer, soft - own))
    return tuple(Neighbour.of(model, other, step, row) for row, (other, step) in enumerate(steps))


def observer_shift(result: WhitenedFit, servo: Servo, second: float) -> tuple[float, float]:
    """Return the change of the gap (rad) in the paper's observer form, and its standard deviation.

    The observer weights the residual by denominator / (s + alpha)^N; one step of Gauss and Newton in that weight.
    """
    reduction = result.reduction
    interval, alpha = reduction.response.interval * reduction.decimation.factor, _ALPHA / second
    model = observer(servo, alpha)
    weight = LagFilter.sampled(model.denominator, model.order, alpha, interval)
    rows = np.array([weight.respond(row) for row in result.table])
    basis = orthonormal(np.vstack([rows[PLACE:], _transients(model.order, alpha * interval, rows.shape[1])]))
    left = project_out(basis, rows[[RESIDUAL, GAP]])
    information = float(left[1] @ left[1])
    if not information > 1e-12 * float(rows[GAP] @ rows[GAP]):
        return 0.0, math.inf
    direction = np.array([weight.respond(left[1][::-1])])[0][::-1] / information
    noise = result.noise.colour_back(direction)
    own = result.std
    return float(left[0] @ left[1]) / information, math.sqrt(max(0.0, float(noise @ noise) - own**2))


def _transients(order: int, step: float, samples: int) -> Array:
    """(order, m) what the observer has not yet forgotten: t^i exp(-t), in steps of alpha times the interval."""
    time = step * np.arange(samples)
    return np.array([time**i * np.exp(-time) for i in range(order)])


_SIGMAS = 3.0  # standard deviations by which another view may disagree
_LIKELIER = 45.0  # gain in likelihood above which what spreads the estimate is the model, not noise
_UNEXPLAINED = 0.05  # of the position's own slow variation
_ROUNDED = 0.4  # of a count: sqrt(2/12), as the encoder's error is not random at the two reversals that show a gap


@dataclass(frozen=True, eq=False)
class FitEvidence:
    """Evidence for and against a fit.

    Attributes
    ----------
    aligned : AlignedFit
    std : float
        rad, calibrated.
    interval : (float, float)
        rad, profile likelihood.
    travel : Travel
        Of the fitted screw.
    shift : ModelShift
        By a free model.
    observer : (float, float)
        rad: by the observer form, and the standard deviation of that.
    lost_motion : float
        rad, range of the lead at rest.
    unexplained : float
        Slow part of the residual over that of the position.
    needed : float
        rad, least travel in each contact.
    smallest : float
        rad: a lower bound below this says nothing.
    count : float
        rad, of the encoder, as stated or as it shows in the angle; 0: none.
    """

    aligned: AlignedFit
    std: float
    interval: Interval
    travel: Travel
    shift: ModelShift
    observer: tuple[float, float]
    lost_motion: float
    unexplained: float
    needed: float
    smallest: float
    count: float = 0.0


def judge(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[GapStatus, tuple[str, ...]]:
    """Decide status and reasons.

    Where the screw was not pushed far enough, the fitted gap means nothing, and other views need not agree with it.
    """
    too_little = one_sided(evidence.travel, evidence.needed, settings)
    disagreements = () if too_little else _disagreements(evidence, settings)
    mismatches = (*misfits(evidence, settings), *disagreements)
    silence = tuple(filter(None, (too_little, _spread(evidence, settings))))
    bound = lower_bound(evidence, settings) > evidence.smallest and math.isinf(evidence.interval[1])
    if evidence.unexplained > _UNEXPLAINED or (mismatches and not math.isinf(evidence.interval[1])):
        return GapStatus.MODEL_MISMATCH, mismatches
    if silence:
        return (GapStatus.LOWER_BOUND if bound else GapStatus.UNIDENTIFIABLE), silence
    return (GapStatus.MODEL_MISMATCH, mismatches) if mismatches else (GapStatus.OK, ())


def misfits(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[str, ...]:
    """List what the fit leaves of the window that neither noise nor the model explains."""
    own = (_unexplained(evidence), _delayed(evidence, settings), _growing(evidence.aligned.whitened))
    return tuple(filter(None, own))


def contacts_seen(aligned: AlignedFit, servo: Servo) -> ContactEvidence:
    """Evidence for a second contact in a window, with the model free within its usual error."""
    result = aligned.whitened
    problem = FreeProblem(
        result.reduction, result.noise, servo, FactorPrior.of_spreads(*FREEDOM), aligned.largest, COMPLIANCE
    )
    return contact_evidence(problem, result.misfit, result.point)


def lower_bound(evidence: FitEvidence, settings: WhitenedSettings) -> float:
    """Gap (rad) below which the window contradicts every gap, even with the model's usual error."""
    return max(0.0, evidence.interval[0] - NORMAL_95 * settings.model_error - evidence.count)


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
    if widest > settings.largest_std:
        return f"the gap is known to {_deg(widest)} only, and {_deg(settings.largest_std)} are allowed"
    rounded = math.hypot(widest, _ROUNDED * evidence.count)
    if rounded > settings.largest_std:
        return (
            f"the gap is known to {_deg(rounded)} only with counts of {_deg(evidence.count)}, and "
            f"{_deg(settings.largest_std)} are allowed"
        )
    return ""


def _unexplained(evidence: FitEvidence) -> str:
    if evidence.unexplained <= _UNEXPLAINED:
        return ""
    return f"the model leaves {100.0 * evidence.unexplained:.0f} % of the position's slow motion unexplained"


def _delayed(evidence: FitEvidence, settings: WhitenedSettings) -> str:
    delay = evidence.aligned.delay
    if abs(delay) <= settings.skew_limit:
        return ""
    allowed = 1e3 * settings.skew_limit
    return f"position and theta_m would be {1e3 * delay:+.3g} ms apart, and {allowed:.3g} ms are allowed"


def _growing(result: WhitenedFit) -> str:
    """Reason against a window in which the gap grows faster than is assumed; empty where it does not."""
    reduction = result.reduction
    if reduction.growth is None:
        return ""
    left = float(result.shares[len(reduction.fixed())])
    rate, assumed = reduction.rate + left, _SIGMAS * reduction.growth.std
    if abs(rate) <= assumed:
        return ""
    per_s = 1.0 / reduction.response.interval
    return f"the gap would grow by {_deg(rate * per_s)}/s within the window, and {_deg(assumed * per_s)}/s are assumed"


def _disagreements(evidence: FitEvidence, settings: WhitenedSettings) -> tuple[str, ...]:
    """List the disagreements of other views of the same window with the fit."""
    sentences = []
    shift, limit = evidence.shift, settings.largest_shift
    if abs(shift.gap) > max(limit, _SIGMAS * shift.std):
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
