"""A look at a window in a fraction of a millisecond: the plain fit at a low rate, and how sure that is.

It says whether a gap is still what it was, and leaves to the estimator what it is now. What is known beforehand makes
it right: the gap, next to which it looks, and the encoder's offset, without which a window of one contact says nothing
of the gap. Without the offset the screw's place in the gap is one of several that are tried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.identify.core.decimation import decimation
from servotwin.identify.core.projection import remove
from servotwin.identify.core.response import response
from servotwin.identify.whitened.misfit import Misfit, Point, Slopes
from servotwin.identify.whitened.reduction import Prior, Reduction, factor_for
from servotwin.identify.whitened.search import Fit, descend
from servotwin.identify.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

PLACES = (-1.0, -0.6, -0.2, 0.2, 0.6, 1.0)
STEPS = 12
_FREE, _PRECISION, _GAIN = 2.0, 1e-6, 1e-6  # ranges of the motor; of the motor's range; of the cost
_FLAT, _PLAIN = 1e-9, 1e-12  # of a derivative's square: below it nothing shows the gap, or the place


@dataclass(frozen=True)
class Quick:
    """The minimum next to a gap.

    Attributes
    ----------
    gap : float
        rad, total.
    std : float
        rad: its spread, for noise as coloured as what is left over and an offset known as well as was said; inf where
        nothing shows the gap.
    misfit : float
        m, root mean square of what is left over.
    settled : bool
        Whether the minimum was reached.
    """

    gap: float
    std: float
    misfit: float
    settled: bool


def quick_fit(window: Window, servo: Servo, gap: float, offset: tuple[float, float] | None = None) -> Quick:
    """Look at a window with theta_m next to a total gap (rad).

    Parameters
    ----------
    window : Window
    servo : Servo
    gap : float
    offset : (float, float), optional
        Mean and standard deviation (rad) of the encoder's offset as earlier windows showed it; None: not known.
    """
    reduction = _slow(window, servo, offset)
    misfit, span = reduction.coarse(), float(np.ptp(reduction.theta_m))
    costs = [misfit.cost(Point(gap, place)) for place in PLACES]
    start = Point(gap, PLACES[int(np.argmin(costs))])
    fit = descend(misfit, start, _FREE * span, _PRECISION * span, STEPS, gain=_GAIN)
    left = max(1, misfit.position.size - len(misfit.basis) - 2)
    std = _std(reduction, misfit, fit, 0.0 if offset is None else offset[1])
    return Quick(float(fit.point.gap), std, math.sqrt(fit.slopes.cost / left), fit.converged)


def _slow(window: Window, servo: Servo, offset: tuple[float, float] | None) -> Reduction:
    """Both channels at the rate that the structure needs."""
    assert window.theta_m is not None
    angle, position = window.theta_m, window.position
    reduce = decimation(factor_for(response(servo, window.sample_rate), angle.size))
    rows = reduce.rows(np.vstack([angle - angle[0], position - position[0]]))
    model = response(servo, window.sample_rate / reduce.factor)
    if offset is None:
        return Reduction.of(rows[0], rows[1], model, skew=False)
    first, home = float(angle[0] + rows[0, 0]), float(position[0] + rows[1, 0])
    gain = model.static_gain
    known = Prior(gain * (first + offset[0]) - home, abs(gain) * offset[1])
    return Reduction.of(rows[0], rows[1], model, known, skew=False)


def _std(reduction: Reduction, misfit: Misfit, fit: Fit, offset_std: float) -> float:
    """Standard deviation (rad) of the gap: of a weighted sum of coloured noise, and of what the offset moves it by."""
    weights = _weights(fit.slopes)
    if weights is None:
        return math.inf
    variance = _coloured(weights, fit.slopes.residual)
    if offset_std > 0.0:
        constant = np.full(weights.size, reduction.response.static_gain)
        remove(misfit.basis, len(misfit.basis), constant)
        variance += (offset_std * float(weights @ constant)) ** 2
    return math.sqrt(variance)


def _weights(slopes: Slopes) -> Array | None:
    """(m,) by how much the gap moves per change of each sample; None: it is not told from the place."""
    by_gap, by_place = slopes.jacobian
    whole, share = float(by_gap @ by_gap), float(by_place @ by_place)
    left = by_gap - (float(by_gap @ by_place) / share) * by_place if share > _PLAIN * whole else by_gap
    size = float(left @ left)
    return left / size if size > _FLAT * whole else None


def _coloured(weights: Array, noise: Array) -> float:
    """Variance of the weighted sum (n,) of noise with the spectrum of one series (n,) of it."""
    count = weights.size
    gains, powers = (np.abs(np.fft.rfft(series, 2 * count)) ** 2 for series in (weights, noise))
    both = gains * powers
    return (2.0 * float(both.sum()) - float(both[0] + both[-1])) / (2.0 * count * count)
