"""The fit of a window whose channels may be delayed against each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.normal import least_squares
from servotwin.estimation.core.response import response
from servotwin.estimation.whitened.misfit import Point
from servotwin.estimation.whitened.passes import Found, candidates, refine
from servotwin.estimation.whitened.reduction import CONSTANT, RESIDUAL, Prior, Reduction, factor_for
from servotwin.estimation.whitened.settings import Settings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

PRECISION, _SLOW_PRECISION = 1e-9, 1e-5  # of the motor's range: how closely a minimum is approached
_ALIGNMENTS, _NARROWEST = 3, 0.01
_FREE = 2.0  # ranges of the motor up to which gaps are searched: from one range on, the screw rests


@dataclass(frozen=True, eq=False)
class Aligned:
    """A fit, and what it says of the channels.

    Attributes
    ----------
    found : Found
    delay : float
        s, by which the position is late.
    span : float
        rad, range of the motor's angle.
    first : float
        rad, the motor's first angle of those that were used.
    """

    found: Found
    delay: float
    span: float
    first: float

    @property
    def largest(self) -> float:
        """rad, up to where gaps were searched."""
        return _FREE * self.span

    @property
    def tolerance(self) -> float:
        """rad, of a search."""
        return PRECISION * self.span


def align_and_fit(
    theta_m: Array, position: Array, rate: float, servo: Servo, prior: float, settings: Settings
) -> Aligned:
    """Fit theta_m (n,) rad and position (n,) m sampled at `rate` (Hz); `prior` (rad) is one of the starts.

    A delay of more than half a sample is taken off in whole samples, and the fit repeated: what is left of it is small
    enough to be linear.
    """
    shift, points = 0, _look_around(theta_m, position, rate, servo, prior, settings)
    for attempt in range(_ALIGNMENTS):
        ahead, behind = max(-shift, 0), max(shift, 0)
        angle = theta_m[ahead : theta_m.size - behind]
        seen = position[behind : position.size - ahead]
        fitted = _fit(angle, seen, rate, servo, points, settings)
        late = _delay(fitted.found) * rate if settings.skew else 0.0
        if abs(late) <= 0.5 or abs(shift + late) > settings.largest_skew * rate or attempt == _ALIGNMENTS - 1:
            break
        shift, points = shift + round(late), [fitted.found.point]
    return Aligned(fitted.found, (shift + late) / rate, fitted.span, fitted.first)


def _look_around(
    theta_m: Array, position: Array, rate: float, servo: Servo, prior: float, settings: Settings
) -> list[Point]:
    """Where the search at the full rate begins."""
    reduce = decimation(factor_for(response(servo, rate), theta_m.size))
    angle, seen = reduce.rows(np.vstack([theta_m - theta_m[0], position - position[0]]))
    model = response(servo, rate / reduce.factor)
    slow = Reduction.of(angle, seen, model, _offset(settings, model.static_gain, float(theta_m[0]), float(position[0])))
    span = float(np.ptp(angle))
    starts = [*gaps_to_try(span, settings.starts), min(prior, _FREE * span)]
    return candidates(slow, starts, _FREE * span, _SLOW_PRECISION * span, settings.kept)


def _fit(
    theta_m: Array, position: Array, rate: float, servo: Servo, points: list[Point], settings: Settings
) -> Aligned:
    span = float(np.ptp(theta_m))
    model = response(servo, rate)
    growth = Prior(0.0, settings.gap_rate / rate) if settings.gap_rate > 0.0 else None
    offset = _offset(settings, model.static_gain, float(theta_m[0]), float(position[0]))
    reduction = Reduction.of(theta_m, position, model, offset, growth, settings.skew)
    found = refine(reduction, points, _FREE * span, PRECISION * span, settings.passes, settings.order)
    return Aligned(found, 0.0, span, float(theta_m[0]))


def gaps_to_try(span: float, count: int) -> list[float]:
    """Zero and gaps from a hundredth of the motor's range (rad) to all of it, each a constant factor wider."""
    return [0.0, *(float(gap) for gap in np.geomspace(_NARROWEST * span, span, count - 1))]


def _offset(settings: Settings, gain: float, angle: float, position: float) -> Prior | None:
    """What is known of the constant in the position (m), which is the encoder's offset and where counting began."""
    if settings.offset is None:
        return None
    mean, std = settings.offset
    return Prior(gain * (angle + mean) - position, abs(gain) * std)


def _delay(found: Found) -> float:
    """s by which the position is late."""
    nuisances = least_squares(found.rows[CONSTANT:], found.rows[RESIDUAL]).coefficients
    fixed = len(found.reduction.fixed())
    moving = nuisances[fixed:]
    return -float(moving[-1])
