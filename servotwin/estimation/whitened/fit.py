"""Fit of a window: from a coarse one to one in the noise that the window really has, channels aligned.

Fit, take the noise from the residual, whiten, fit again. A delay between the channels of more than half a sample is
taken off in whole samples, and the fit repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.least_squares import least_squares, spread
from servotwin.estimation.core.response import response
from servotwin.estimation.core.whitening import Autoregression, burg, with_noise_restored
from servotwin.estimation.whitened.reduction import (
    CONSTANT,
    GAP,
    PLACE,
    RESIDUAL,
    Misfit,
    NuisancePrior,
    Point,
    Reduction,
    factor_for,
)
from servotwin.estimation.whitened.search import (
    SearchResult,
    continued,
    descend,
    in_contact,
    off_the_plain,
    off_the_plateau,
    search,
)
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_PLAIN = 2  # passes before the fit's own share of the noise is put back: too early, it hides a notch
_EARLY, _PLACES = (
    1,
    (-0.85, 0.0, 0.85),
)  # the pass in which a growing gap is searched from other places, and these places
_GLANCE = 8  # steps of that search
_ROUGH, _FINE = 1e-5, 1e-7  # of the cost: what a descent may leave; 1e-7 is below a hundredth of a standard deviation
_SAME = 1e-3  # of the cost: minima that are no deeper apart are one, or one plain on which the screw rests


@dataclass(frozen=True, eq=False)
class WhitenedFit:
    """A fit with the noise in which it was made.

    Attributes
    ----------
    reduction : Reduction
    misfit : Misfit
    fit : SearchResult
    noise : Autoregression
    table : (k, m) array
        Of the reduction at the fit.
    rows : (k, M) array
        The same whitened.
    evaluations : int
    """

    reduction: Reduction
    misfit: Misfit
    fit: SearchResult
    noise: Autoregression
    table: Array
    rows: Array
    evaluations: int

    @cached_property
    def shares(self) -> Array:
        """(k - 3,) fitted shares of the nuisances."""
        return least_squares(self.rows[CONSTANT:], self.rows[RESIDUAL]).coefficients

    @cached_property
    def residual(self) -> Array:
        """(m,) m, residual of the reduced position."""
        return np.asarray(self.table[RESIDUAL] - self.shares @ self.table[CONSTANT:])

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residual, m."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def point(self) -> Point:
        """The fit's gap and place."""
        return self.fit.point

    @property
    def variance(self) -> float:
        """Variance of the whitened residual; 1 where the noise was well described."""
        return self.fit.slopes.cost / max(1, self.rows.shape[1] - len(self.misfit.basis) - 2)

    @property
    def std(self) -> float:
        """Standard deviation of the gap from the Schur complement of the information, rad; inf where there is none."""
        return spread(self.rows[GAP], self.rows[PLACE:])


def candidates(slow: Reduction, gaps: Sequence[float], largest: float, tolerance: float, count: int) -> list[Point]:
    """Find the best few different minima of a window at its low rate, at a tenth of the cost.

    Parameters
    ----------
    slow : Reduction
        Of both channels, decimated.
    gaps : sequence of float
        rad, where to look.
    largest, tolerance : float
        rad, of the search.
    count : int
        Most minima.
    """
    misfit = slow.coarse()
    fits = sorted(search(misfit, gaps, largest, tolerance), key=lambda fit: fit.slopes.cost)
    fits.insert(0, off_the_plateau(misfit, fits[0], largest, tolerance))
    different = fits[:1]
    for fit in fits[1:]:
        if fit.slopes.cost > (1.0 + _SAME) * different[-1].slopes.cost:
            different.append(fit)
    return [fit.point for fit in different[:count]]


def _best_of(
    misfit: Misfit, points: Sequence[Point], largest: float, tolerance: float, steps: int = 60
) -> SearchResult:
    """Find the lowest of the minima that at most `steps` steps from some points lead to."""
    fits = [descend(misfit, point, largest, tolerance, steps, gain=_ROUGH) for point in points]
    best = min(fits, key=lambda fit: fit.slopes.cost)
    return SearchResult(best.point, best.slopes, sum(fit.evaluations for fit in fits), best.converged)


def refine(
    reduction: Reduction,
    points: Sequence[Point],
    largest: float,
    tolerance: float,
    passes: int,
    order: int,
    nearby: WhitenedFit | None = None,
) -> WhitenedFit:
    """Fit in the noise of the fit's own residual, in some passes with autoregressions of at most `order`.

    The first fit and the last start from all `points`: in the right noise another minimum may lie lower. With a
    `nearby` fit, of the same samples with nearly the same model, only the last pass is made, from the first point on,
    and hum is the one that was found there.
    """
    if nearby is None:
        begun = _in_white_noise(reduction, points, largest, tolerance)
        first, point, noise, evaluations = 0, begun.point, Autoregression.white(1.0), begun.evaluations
    else:
        first, point, noise, evaluations = passes - 1, points[0], nearby.noise, 0
        reduction = replace(reduction, rate=nearby.reduction.rate, hum=nearby.reduction.hum)
    for number in range(first, passes):
        table = reduction.table(point)
        if nearby is None and number == passes - 1:
            reduction, table, noise = _with_hum(reduction, point, table, noise, order)
        noise = estimate_noise(reduction, table, noise, order, number >= _PLAIN)
        reduction = reduction.growing(noise, table)
        # In a growing gap the rate, and with it the table, has changed.
        misfit = reduction.misfit(noise, point, None if reduction.growth else table)
        last = number == passes - 1
        starts = [point, *([*points, *in_contact(point)] if last else [])]
        fit = _best_of(misfit, list(dict.fromkeys(starts)), largest, tolerance)
        if reduction.growth and number == _EARLY:
            others = _best_of(misfit, _elsewhere(fit.point), largest, tolerance, _GLANCE)
            fit = min(fit, others, key=lambda one: one.slopes.cost)
        point, evaluations = fit.point, evaluations + fit.evaluations
    fit = off_the_plain(misfit, fit, largest, tolerance)
    fit = descend(misfit, fit.point, largest, tolerance, gain=_FINE)
    table = reduction.table(fit.point)
    rows = reduction.prepared(noise, table, CONSTANT)
    return WhitenedFit(reduction, misfit, fit, noise, table, rows, evaluations + fit.evaluations)


def _with_hum(
    reduction: Reduction, point: Point, table: Array, noise: Autoregression, order: int
) -> tuple[Reduction, Array, Autoregression]:
    """Take hum that the residual at a point shows as a nuisance; the table and the noise are without it then."""
    humming = reduction.humming(noise, table, order)
    if not humming.hum:
        return reduction, table, noise
    table = humming.table(point)
    # In noise that follows the hum its size would count as unknown, and be put back into the noise.
    return humming, table, estimate_noise(humming, table, noise, order, restore=False)


def _in_white_noise(reduction: Reduction, points: Sequence[Point], largest: float, tolerance: float) -> SearchResult:
    """Find the lowest minimum that some points lead to, the noise taken as white."""
    white = reduction.coarse()
    fit = continued(white, _best_of(white, points, largest, tolerance), largest, tolerance)
    return off_the_plain(white, fit, largest, tolerance)


def _elsewhere(point: Point) -> list[Point]:
    """Other places in a growing gap: at a wrong rate a wrong place fits, and the rate then stays wrong."""
    return [point._replace(place=place) for place in _PLACES]


def estimate_noise(
    reduction: Reduction, table: Array, noise: Autoregression, order: int, restore: bool
) -> Autoregression:
    """Estimate the noise from the residual of a fit, whose table is given, that was made with a first idea of it.

    With `restore`, the noise that the fit may have taken away is restored.
    """
    rows = reduction.prepared(noise, table, CONSTANT)
    residual = reduction.residual(table, rows)
    if not np.any(residual):
        return Autoregression.white(1.0)
    if not restore:
        return burg(residual[None], order).at_least(reduction.rounding)
    root = least_squares(rows[GAP:], rows[RESIDUAL]).root
    return burg(with_noise_restored(residual, table[GAP:], root), order).at_least(reduction.rounding)


_PRECISION, _SLOW_PRECISION = 1e-9, 1e-5  # of the motor's range: how closely a minimum is approached
_ALIGNMENTS, _NARROWEST = 3, 0.01
_FREE = 2.0  # ranges of the motor up to which gaps are searched: from one range on, the screw rests


@dataclass(frozen=True, eq=False)
class AlignedFit:
    """A fit with the delay between its channels.

    Attributes
    ----------
    whitened : WhitenedFit
    shift : int
        Samples by which the position is taken as late in the fit.
    delay : float
        s, by which it is late: the shift and what the fit finds beside it.
    span : float
        rad, range of the motor's angle.
    first : float
        rad, the motor's first angle of those that were used.
    """

    whitened: WhitenedFit
    shift: int
    delay: float
    span: float
    first: float

    @property
    def largest(self) -> float:
        """Largest gap of the search, rad."""
        return _FREE * self.span

    @property
    def tolerance(self) -> float:
        """Accuracy of the search, rad."""
        return _PRECISION * self.span


def align_and_fit(
    theta_m: Array,
    position: Array,
    rate: float,
    servo: Servo,
    points: list[Point],
    settings: WhitenedSettings,
    nearby: AlignedFit | None = None,
) -> AlignedFit:
    """Fit theta_m (n,) rad and position (n,) m sampled at `rate` (Hz) from some points on.

    A delay of more than half a sample is taken off in whole samples, and the fit repeated: what is left of it is small
    enough to be linear. `nearby`: a fit of the same samples to nearly the same servo, whose shift and noise are right
    but for little.
    """
    shift = 0 if nearby is None else nearby.shift
    known = None if nearby is None else nearby.whitened
    for attempt in range(_ALIGNMENTS):
        ahead, behind = max(-shift, 0), max(shift, 0)
        angle = theta_m[ahead : theta_m.size - behind]
        measured = position[behind : position.size - ahead]
        whitened = _fit(angle, measured, rate, servo, points, settings, known)
        late = _delay(whitened) * rate if settings.skew else 0.0
        if abs(late) <= 0.5 or abs(shift + late) > settings.skew_limit * rate or attempt == _ALIGNMENTS - 1:
            break
        shift, points, known = shift + round(late), [whitened.point], None
    return AlignedFit(whitened, shift, (shift + late) / rate, float(np.ptp(angle)), float(angle[0]))


def coarse_search(
    theta_m: Array, position: Array, rate: float, servo: Servo, prior: float, settings: WhitenedSettings
) -> tuple[Reduction, list[Point]]:
    """Decimate both channels, and find the points from which the search at the full rate begins.

    `prior` (rad) is one of the gaps from which these are searched.
    """
    reduce = decimation(factor_for(response(servo, rate), theta_m.size))
    angle, reduced = reduce.rows(np.vstack([theta_m - theta_m[0], position - position[0]]))
    model = response(servo, rate / reduce.factor)
    slow = Reduction.of(
        angle, reduced, model, _offset(settings, model.static_gain, float(theta_m[0]), float(position[0]))
    )
    span = float(np.ptp(angle))
    starts = [*gaps_to_try(span, settings.starts), min(prior, _FREE * span)]
    return slow, candidates(slow, starts, _FREE * span, _SLOW_PRECISION * span, settings.refined)


def _fit(
    theta_m: Array,
    position: Array,
    rate: float,
    servo: Servo,
    points: list[Point],
    settings: WhitenedSettings,
    nearby: WhitenedFit | None,
) -> WhitenedFit:
    span = float(np.ptp(theta_m))
    model = response(servo, rate)
    growth = NuisancePrior(0.0, settings.gap_rate / rate) if settings.gap_rate > 0.0 else None
    offset = _offset(settings, model.static_gain, float(theta_m[0]), float(position[0]))
    reduction = Reduction.of(theta_m, position, model, offset, growth, settings.skew)
    # The noise is that of the decimated samples.
    same = nearby if nearby is not None and nearby.reduction.decimation == reduction.decimation else None
    return refine(reduction, points, _FREE * span, _PRECISION * span, settings.passes, settings.order, same)


def gaps_to_try(span: float, count: int) -> list[float]:
    """Zero and gaps from a hundredth of the motor's range (rad) to all of it, each a constant factor wider."""
    return [0.0, *(float(gap) for gap in np.geomspace(_NARROWEST * span, span, count - 1))]


def _offset(settings: WhitenedSettings, gain: float, angle: float, position: float) -> NuisancePrior | None:
    """Prior of the constant in the position (m): the encoder's offset and the origin of counting."""
    if settings.offset is None:
        return None
    mean, std = settings.offset
    return NuisancePrior(gain * (angle + mean) - position, abs(gain) * std)


def _delay(result: WhitenedFit) -> float:
    """Delay of the position, s."""
    return -float(result.shares[-1])


def plain_fit(window: Window, servo: Servo, gap: float) -> SearchResult:
    """The minimum nearest to a total gap (rad): no whitening, no other start, no verdict, no delay.

    The screw begins in the middle of the gap.
    """
    assert window.theta_m is not None
    reduction = Reduction.of(window.theta_m, window.position, response(servo, window.sample_rate), skew=False)
    span = float(np.ptp(window.theta_m))
    return descend(reduction.coarse(), Point(gap, 0.0), 2.0 * span, _PRECISION * span)
