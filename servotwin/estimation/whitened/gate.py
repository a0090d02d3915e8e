"""What a fit may be used for: the status of an estimate and the reasons for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servotwin.estimation.core.contacts import Travel
from servotwin.estimation.estimate import NORMAL_95, GapStatus, Interval
from servotwin.estimation.whitened.aligned import Aligned
from servotwin.estimation.whitened.model_check import Shift
from servotwin.estimation.whitened.settings import Settings

_SIGMAS = 3.0
_SMALLEST_BOUND = math.radians(0.1)  # a lower bound below this says nothing
_LIKELIER = 45.0  # gain in likelihood above which what spreads the estimate is the model, not noise
_UNEXPLAINED = 0.05  # of the position's own slow variation


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything that is held against a fit, or for it.

    Attributes
    ----------
    aligned : Aligned
    std : float
        rad, calibrated.
    interval : (float, float)
        rad, profile likelihood.
    travel : Travel
        Of the fitted screw.
    shift : Shift
        By a free model.
    observer : (float, float)
        rad: by the observer form, and the standard deviation of that.
    lost_motion : float
        rad: range of the lead at rest.
    unexplained : float
        Slow part of the residual over that of the position.
    """

    aligned: Aligned
    std: float
    interval: Interval
    travel: Travel
    shift: Shift
    observer: tuple[float, float]
    lost_motion: float
    unexplained: float


def judge(seen: Evidence, settings: Settings) -> tuple[GapStatus, tuple[str, ...]]:
    """Status and reasons.

    Where the screw was not pushed as it must, the fitted gap is nobody's: that other views put it elsewhere is no news.
    """
    too_little = one_sided(seen.travel, settings)
    disagreements = () if too_little else _disagreements(seen, settings)
    mismatches = tuple(filter(None, (_unexplained(seen), _delayed(seen, settings), *disagreements)))
    silence = tuple(filter(None, (too_little, _spread(seen, settings))))
    bound = lower_bound(seen, settings) > _SMALLEST_BOUND and math.isinf(seen.interval[1])
    if seen.unexplained > _UNEXPLAINED or (mismatches and not math.isinf(seen.interval[1])):
        return GapStatus.MODEL_MISMATCH, mismatches
    if silence:
        return (GapStatus.LOWER_BOUND if bound else GapStatus.UNIDENTIFIABLE), silence
    return (GapStatus.MODEL_MISMATCH, mismatches) if mismatches else (GapStatus.OK, ())


def lower_bound(seen: Evidence, settings: Settings) -> float:
    """rad: what the window contradicts every gap below of, were the model off by its usual error."""
    return max(0.0, seen.interval[0] - NORMAL_95 * settings.model_error)


def one_sided(seen: Travel, settings: Settings) -> str:
    """Pushed both ways the screw shows the gap; pushed one way only when the encoder's offset is known."""
    forwards, backwards = seen.forwards, seen.backwards
    needed = settings.contact_travel
    enough = min(forwards, backwards) if settings.offset is None else max(forwards, backwards)
    if enough >= needed:
        return ""
    ways = "both ways" if settings.offset is None else "one way"
    return (
        f"the screw was pushed {_deg(forwards)} forwards and {_deg(backwards)} backwards, and {_deg(needed)} are "
        f"needed {ways}"
    )


def _spread(seen: Evidence, settings: Settings) -> str:
    if math.isinf(seen.std):
        return "the measurements do not depend on the gap"
    if math.isinf(seen.interval[1]):
        return "the window contradicts no large gap"
    gap = seen.aligned.found.point.gap
    widest = max(seen.std, (seen.interval[1] - gap) / NORMAL_95, (gap - seen.interval[0]) / NORMAL_95)
    if widest > settings.largest_std:
        return f"the gap is known to {_deg(widest)} only, and {_deg(settings.largest_std)} are allowed"
    return ""


def _unexplained(seen: Evidence) -> str:
    if seen.unexplained <= _UNEXPLAINED:
        return ""
    return f"the model leaves {100.0 * seen.unexplained:.0f} % of the position's slow motion unexplained"


def _delayed(seen: Evidence, settings: Settings) -> str:
    delay = seen.aligned.delay
    if abs(delay) <= settings.largest_skew:
        return ""
    allowed = 1e3 * settings.largest_skew
    return f"position and theta_m would be {1e3 * delay:+.3g} ms apart, and {allowed:.3g} ms are allowed"


def _disagreements(seen: Evidence, settings: Settings) -> tuple[str, ...]:
    """What other views of the same window say against the fit."""
    found = []
    shift, limit = seen.shift, settings.largest_shift
    if abs(shift.gap) > max(limit, _SIGMAS * shift.std):
        found.append(f"with the model free the gap would move by {_deg(shift.gap)}: {shift.words}")
    if shift.gain > _LIKELIER and _spread(seen, settings):
        found.append(f"freeing the model makes the window far likelier: {shift.words}")
    move, std = seen.observer
    if abs(move) > max(2.0 * limit, _SIGMAS * std):
        found.append(f"the observer form puts the gap {_deg(move)} away, with a joint spread of {_deg(std)}")
    gap = seen.aligned.found.point.gap
    if seen.lost_motion > 1.05 * gap + _SIGMAS * seen.std + settings.contact_travel:
        found.append(f"the lost motion at rest is {_deg(seen.lost_motion)}, more than the fitted gap of {_deg(gap)}")
    return tuple(found)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.3g} deg"
