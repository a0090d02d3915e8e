"""Verdict on a fit: status, reasons and spread of a gap."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from servotwin.estimation.estimate import NORMAL_95, GapStatus, UnknownRatio
from servotwin.estimation.output_error.between_samples import error_between_samples, moved_between_samples
from servotwin.estimation.output_error.bound import likely_fits, smallest_half
from servotwin.estimation.output_error.carried import carried
from servotwin.estimation.output_error.fit import Fit, Search, one_flank
from servotwin.estimation.output_error.held_chain import FRICTION, HeldChainModel
from servotwin.estimation.output_error.jitter import TimeJitter, time_jitter
from servotwin.estimation.output_error.mismatches import DOUBT, grown, mismatches, too_small
from servotwin.estimation.output_error.models import HALF, RATIO, ShaftModel
from servotwin.estimation.output_error.possible import PossibleHalf
from servotwin.estimation.output_error.rounding import all_rounding, rounded
from servotwin.estimation.output_error.search import one_flank_without_a_gap
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.output_error.soft_contact import moved_by_contact
from servotwin.estimation.output_error.softer_shaft import softer_explains, softer_is_better
from servotwin.estimation.output_error.unexplained import unexplained

BELIEVED = 60.0  # rise of the cost without the second flank, over the noise's variance
_ALIKE = 0.5  # of a count: motions that differ by less in every sample may round to the same counts
# Counts: a screw that follows its motor to and fro without a gap differs by more from one that does so one way only.
_PLAIN = 4.0
RIVAL = 30.0  # the same of another gap that explains the window as well
_TRAVEL = 1e-3  # of the motor's travel: a spread that is small whatever the gap
_BOUND, _BOUND_COUNTS = 0.9, 10.0  # of the gaps that are excluded; smallest bound that says anything
_RATCHET = 4.0  # of the noise left in the motor's angle: its extremes push the load, so that the gap seems wider
_ROUNDED = 1.0  # of a count: standard deviation of an error that does not average out
# The motor's place between two samples: the error that counts, of half the gap, and the samples that may have it.
_HIDDEN, _FEW = 0.25, 10


@dataclass(frozen=True)
class JudgedFit:
    """Status of a gap with its spread, all at the load.

    Attributes
    ----------
    status : GapStatus
    half : float
        Half gap, or half the lower bound.
    std, std_total : float
        Of the half gap.
    reasons : tuple of str
    ratio : UnknownRatio, optional
        The transmission's ratio, where the window would show the gap with it.
    one_flank : bool
        True where one flank explains the window nearly as well as two.
    """

    status: GapStatus
    half: float = math.nan
    std: float = math.inf
    std_total: float = math.inf
    reasons: tuple[str, ...] = ()
    ratio: UnknownRatio | None = None
    one_flank: bool = False


def judge(
    found: Search,
    settings: OutputErrorSettings,
    unit: float,
    possible: PossibleHalf | None = None,
    jitter: float = 0.0,
) -> JudgedFit:
    """Decide on a fit.

    Parameters
    ----------
    found : Search
    settings : OutputErrorSettings
    unit : float
        Total gap at the motor (rad) per half gap at the load, for the words.
    possible : PossibleHalf, optional
        What the window leaves possible.
    jitter : float
        Standard deviation of the noise of the motor's angle beyond its counts, at the load (m or rad), where nothing
        smooths it.
    """
    known = _known_half(found, settings, unit, possible, jitter)
    likely = found.best.values if possible is None else possible.unknowns
    against = mismatches(found, likely, settings.gap_rate / unit, settings.model_share * known.half)
    if against:
        return JudgedFit(GapStatus.MODEL_MISMATCH, reasons=against)
    if small := too_small(found):
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(small,))
    single, likely_single = _single(found, known)
    if likely_single:
        bounded = _bounded(found, single, "one flank explains the window nearly as well as two")
        return replace(bounded, one_flank=True)
    allowed = largest_std(found, known.half, settings)
    doubts, explained = _doubts(found, known, allowed, unit, settings.friction)
    if not doubts and _out_of_reach(found, known.half + NORMAL_95 * explained):
        return _bounded(found, single, "the interval contains gaps that the motor does not cross in the window")
    if not doubts and (softer := softer_is_better(found)):
        return _softer(found, softer)
    if not doubts:
        return JudgedFit(GapStatus.OK, known.half, known.std, explained)
    ratio = None
    if possible is not None and known.std > allowed:
        ratio = _unknown_ratio(found, possible, settings, allowed, unit)
    reasons = doubts if ratio is None else (*doubts, _not_told(ratio))
    return JudgedFit(GapStatus.UNIDENTIFIABLE, math.nan, known.std, known.total, reasons, ratio)


def _softer(found: Search, words: str) -> JudgedFit:
    """Decide on a window that a much softer shaft explains better: no mismatch where that is a matter of counts."""
    if all_rounding(found):
        rounding = "the encoders' rounding may be all that the model leaves with the stated one"
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(words, rounding))
    return JudgedFit(GapStatus.MODEL_MISMATCH, reasons=(words,))


class _KnownHalf(NamedTuple):
    """Half gap with its standard deviation, statistical and in total, m or rad at the load."""

    half: float
    std: float
    total: float


def _known_half(
    found: Search, settings: OutputErrorSettings, unit: float, possible: PossibleHalf | None, jitter: float
) -> _KnownHalf:
    half, std = float(found.best.values[HALF]), math.hypot(found.best.std(HALF, found.free), rounded(found))
    if possible is not None:
        half, std = possible.mean, math.hypot(std, possible.std)
    std *= settings.calibration
    growth = grown(found, settings.gap_rate / unit)
    floor = 0.5 * _ROUNDED * found.problem.count
    total = math.hypot(DOUBT * std, settings.model_share * half, floor, growth, _RATCHET * jitter)
    return _KnownHalf(half, std, total)


def _single(found: Search, known: _KnownHalf) -> tuple[Fit, bool]:
    """The best fit with one flank, and whether it explains the window nearly as well as two."""
    best, zero = found.best, known.half <= NORMAL_95 * known.total
    # A minimum that does not show the gap has one flank, wherever the other one is.
    singles = [one_flank(found), *(fit for fit in found.others if math.isinf(fit.std(HALF, found.free)))]
    if zero:
        singles += one_flank_without_a_gap(found)
    single = min(singles, key=lambda fit: fit.cost)
    rise = (single.cost - best.cost) / best.variance()
    least = _PLAIN if zero and isinstance(found.problem.model, HeldChainModel) else _ALIKE
    return single, rise < BELIEVED or any(_alike(found, fit, least) for fit in singles)


def _bounded(found: Search, single: Fit, words: str) -> JudgedFit:
    """Decide on a window that shows one flank, for a reason in words."""
    count = found.problem.count
    hidden = _hidden_friction(found, single) + float(np.max(error_between_samples(found, _FEW)))
    half = smallest_half(found, single)
    bound = _BOUND * 2.0 * (half - hidden) - count
    enough = bound > _BOUND_COUNTS * count
    if enough and softer_explains(found, half, *likely_fits(found, single)):
        softer = "a shaft much softer than the stated one, which friction winds up, explains it with a smaller gap"
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(words, softer))
    status = GapStatus.LOWER_BOUND if enough else GapStatus.UNIDENTIFIABLE
    return JudgedFit(status, 0.5 * bound if enough else math.nan, reasons=(words,))


def bounded_by_both(learnt: JudgedFit, freed: JudgedFit) -> JudgedFit:
    """Decide on a lower bound within what was learnt of the machine, beside the fit with the usual freedom.

    A machine that has changed is one of which nothing was learnt: gaps that only the earlier one excludes are not.
    """
    if freed.status is GapStatus.LOWER_BOUND:
        return min(learnt, freed, key=lambda each: each.half)
    if freed.status is not GapStatus.OK:
        return freed
    words = "one flank explains the window within what was learnt of the machine, and two with the usual freedom"
    return JudgedFit(GapStatus.MODEL_MISMATCH, reasons=(words,))


def _out_of_reach(found: Search, half: float) -> bool:
    """Tell whether a half gap (m or rad at the load) that holds the driven end is wider than the motor's way.

    A load that swings on its own hides how little the motor pushes it: the gap is then the motor's way.
    """
    return isinstance(found.problem.model, HeldChainModel) and 2.0 * half >= float(np.ptp(found.problem.drive))


def _doubts(
    found: Search, known: _KnownHalf, allowed: float, unit: float, width: float
) -> tuple[tuple[str, ...], float]:
    """List what speaks against a half gap, and its standard deviation with all that the model leaves.

    `allowed` (m or rad at the load) is a standard deviation, `width` the half-width of the stated friction.
    """
    half, std, total = known
    friction = _friction_doubt(found, half, width)
    left, times, sharp = unexplained(found), time_jitter(found), moved_between_samples(found)
    doubts = (
        _wide(std, allowed, unit),
        _rival(found, half, total, unit),
        _hidden(found, half),
        _of_friction(found, friction, allowed, unit),
        _of_slow_motion(left, half, allowed, unit),
        _of_jitter(times, allowed, unit),
        _of_sharp_motion(sharp, allowed, unit),
        carried(found) if half <= NORMAL_95 * total else "",
    )
    contact = 0.0 if any(doubts) else moved_by_contact(found)
    explained = math.hypot(total, friction.std, DOUBT * left, DOUBT * times.half, DOUBT * contact, DOUBT * sharp)
    return tuple(filter(None, doubts)), explained


class _FrictionDoubt(NamedTuple):
    """Change of the half gap that the stated friction would make, with its standard deviation, m or rad at the load.

    `counts`: true where it speaks against the gap as far as it is more than allowed.
    """

    hidden: float
    std: float
    counts: bool


def _friction_doubt(found: Search, half: float, width: float) -> _FrictionDoubt:
    """Doubt of a half gap by the friction that fits best, which is believed within a half-width of the stated one.

    The interval then just contains the gap with the stated friction, and the doubt speaks against the gap only where
    that one would be 0.
    """
    hidden, model = _hidden_friction(found, found.best), found.problem.model
    if not (isinstance(model, HeldChainModel) and model.believes(found.best.values, width)):
        return _FrictionDoubt(hidden, hidden, True)
    return _FrictionDoubt(hidden, hidden / NORMAL_95, hidden > half)


def _hidden_friction(found: Search, fit: Fit) -> float:
    """Change of the half gap (m or rad at the load) of a fit that hides another load friction than the stated one."""
    model = found.problem.model
    return model.hidden_friction(fit.values) if isinstance(model, ShaftModel | HeldChainModel) else 0.0


def _alike(found: Search, single: Fit, least: float) -> bool:
    """True where the best fit and one with a single flank differ by less than `least` counts in every sample.

    The noise is learnt at the best fit, and speaks for it: what rounding hides is no evidence of a second flank.
    """
    return float(np.max(np.abs(single.raw - found.best.raw))) < least * found.problem.count


def largest_std(found: Search, half: float, settings: OutputErrorSettings) -> float:
    """Largest standard deviation with which a half gap counts as known, m or rad at the load."""
    travel = 0.5 * _TRAVEL * float(np.ptp(found.problem.drive))
    return max(settings.largest_share * half, 0.5 * settings.counts * found.problem.count, travel)


def _wide(std: float, allowed: float, unit: float) -> str:
    if math.isinf(std):
        return "the measurements do not depend on the gap"
    if std <= allowed:
        return ""
    return f"the gap is known to {_deg(unit * std)} only, and {_deg(unit * allowed)} are allowed"


def _of_friction(found: Search, friction: _FrictionDoubt, allowed: float, unit: float) -> str:
    """Sentence for a half gap (m or rad at the load) that would be another with the stated friction."""
    if not friction.counts or friction.hidden <= allowed:
        return ""
    names = (unknown.name for unknown in found.problem.model.unknowns)
    fitted = dict(zip(names, found.best.values.tolist(), strict=True)).get(FRICTION)
    best = "" if fitted is None else f"; the friction that fits best is {100.0 * math.expm1(fitted):+.2g} % off"
    return (
        f"with the stated load friction the gap would be {_deg(unit * friction.hidden)} off, and "
        f"{_deg(unit * allowed)} are allowed: slow motion does not tell friction from a gap{best}"
    )


def _of_slow_motion(left: float, half: float, allowed: float, unit: float) -> str:
    """Sentence for slow motion whose interval contains every smaller half gap (m or rad at the load): no news."""
    hidden = NORMAL_95 * DOUBT * left
    if hidden <= max(half, NORMAL_95 * DOUBT * allowed):
        return ""
    return (
        f"the model leaves slow motion that may hide {_deg(unit * hidden)}, and the gap would be {_deg(unit * half)}: "
        "friction, shaft or a sensor are of another kind"
    )


def _of_jitter(times: TimeJitter, allowed: float, unit: float) -> str:
    """Sentence for errors that grow with the speed too much for a half gap (m or rad at the load)."""
    if times.half <= allowed:
        return ""
    cause = (
        "what the model leaves grows with the speed, and lasts for more than a sample as no noise does"
        if times.lasting
        else f"the position's noise grows with the speed, as where the times of the samples jitter by "
        f"{1e3 * times.time:.2g} ms"
    )
    return f"{cause}: that moves the gap by {_deg(unit * times.half)}, and {_deg(unit * allowed)} are allowed"


def _of_sharp_motion(moved: float, allowed: float, unit: float) -> str:
    """Sentence for places between samples that move a half gap (m or rad at the load) too much."""
    if moved <= allowed:
        return ""
    return (
        f"the motor turns so sharply that its places between two samples may move the gap by {_deg(unit * moved)}, and "
        f"{_deg(unit * allowed)} are allowed: a higher sample rate is needed"
    )


def _hidden(found: Search, half: float) -> str:
    """Sentence for a motor that moves by a share of the gap between two samples, and the samples do not show how."""
    error = float(np.sort(error_between_samples(found, _FEW))[-_FEW])
    if error <= _HIDDEN * half:
        return ""
    return (
        f"the motor turns so sharply between two samples that they leave its place open by "
        f"{100.0 * error / half:.0f} % of half the gap: a higher sample rate is needed"
    )


def _unknown_ratio(
    found: Search, possible: PossibleHalf, settings: OutputErrorSettings, allowed: float, unit: float
) -> UnknownRatio | None:
    """The ratio, where with it the half gap would be known as well as is `allowed`; None: it would not.

    `allowed` (m or rad at the load) is a standard deviation.
    """
    free = found.free.copy()
    free[RATIO] = False
    given = replace(found, free=free)
    left = math.hypot(found.best.std(HALF, free), rounded(given), possible.std_with_ratio)
    room = (allowed / settings.calibration) ** 2 - left**2
    if not room > 0.0 or possible.slope == 0.0:
        return None
    # Errors of rounding repeat with the motion: what such a window seems to tell of the ratio does not count.
    known, slope = found.problem.model.unknowns[RATIO].std, possible.slope
    widest = possible.mean - slope * possible.ratio + NORMAL_95 * (abs(slope) * known + left)
    return UnknownRatio(known, math.sqrt(room) / abs(slope), unit * widest)


def _not_told(ratio: UnknownRatio) -> str:
    return (
        f"gap and ratio are not told apart: the ratio is known to {100.0 * ratio.known:.2g} %, and "
        f"{100.0 * ratio.needed:.2g} % would show the gap"
    )


def _rival(found: Search, half: float, total: float, unit: float) -> str:
    best = found.best
    for other in found.others:
        apart = abs(float(other.values[HALF]) - half)
        if apart > NORMAL_95 * total and (other.cost - best.cost) / best.variance() < RIVAL:
            return f"a gap of {_deg(unit * float(other.values[HALF]))} explains the window nearly as well"
    return ""


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.3g} deg"
