"""From a coarse fit to one in the noise that the window really has: fit, look at what is left, whiten, fit again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.estimation.core.normal import least_squares
from servotwin.estimation.core.projection import spread
from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.whitened.misfit import Misfit, Point
from servotwin.estimation.whitened.reduction import CONSTANT, GAP, PLACE, RESIDUAL, Reduction
from servotwin.estimation.whitened.search import (
    Fit,
    continued,
    descend,
    in_contact,
    off_the_plain,
    off_the_plateau,
    search,
)
from servotwin.plant.signals import Array

_PLAIN = 2  # passes before the fit's own share of the noise is put back: too early, it hides a notch
_EARLY, _PLACES = 1, (-0.85, 0.0, 0.85)  # the pass in which a growing gap is looked at from other places, and these
_GLANCE = 8  # steps from there
_ROUGH, _FINE = 1e-5, 1e-7  # of the cost: what a descent may leave; 1e-7 is below a hundredth of a standard deviation
_SAME = 1e-3  # of the cost: minima that are no deeper apart are one, or one plain on which the screw rests


@dataclass(frozen=True, eq=False)
class Found:
    """A fit with the noise in which it was made.

    Attributes
    ----------
    reduction : Reduction
    misfit : Misfit
    fit : Fit
    noise : Autoregression
    rows : (k, m) array
        Table of the reduction at the fit, whitened.
    evaluations : int
    """

    reduction: Reduction
    misfit: Misfit
    fit: Fit
    noise: Autoregression
    rows: Array
    evaluations: int

    @property
    def point(self) -> Point:
        """The fit's gap and place."""
        return self.fit.point

    @property
    def variance(self) -> float:
        """Of the whitened residual; 1 where the noise was well described."""
        return self.fit.slopes.cost / max(1, self.rows.shape[1] - len(self.misfit.basis) - 2)

    @property
    def std(self) -> float:
        """Standard deviation of the gap from the Schur complement of the information, rad; inf where there is none."""
        return spread(self.rows[GAP], self.rows[PLACE:])


def candidates(slow: Reduction, gaps: Sequence[float], largest: float, tolerance: float, count: int) -> list[Point]:
    """The best few different minima of a window at its low rate, where looking around costs a tenth.

    Parameters
    ----------
    slow : Reduction
        Of both channels, decimated.
    gaps : sequence of float
        rad, where to look.
    largest, tolerance : float
        rad, of the search.
    count : int
        At most as many.
    """
    misfit = slow.coarse()
    fits = sorted(search(misfit, gaps, largest, tolerance), key=lambda fit: fit.slopes.cost)
    fits.insert(0, off_the_plateau(misfit, fits[0], largest, tolerance))
    different = fits[:1]
    for fit in fits[1:]:
        if fit.slopes.cost > (1.0 + _SAME) * different[-1].slopes.cost:
            different.append(fit)
    return [fit.point for fit in different[:count]]


def best_of(misfit: Misfit, points: Sequence[Point], largest: float, tolerance: float, steps: int = 60) -> Fit:
    """The lowest of the minima nearest to some points, or of what so many steps lead to."""
    fits = [descend(misfit, point, largest, tolerance, steps, gain=_ROUGH) for point in points]
    best = min(fits, key=lambda fit: fit.slopes.cost)
    return Fit(best.point, best.slopes, sum(fit.evaluations for fit in fits), best.converged)


def refine(
    reduction: Reduction, points: Sequence[Point], largest: float, tolerance: float, passes: int, order: int
) -> Found:
    """The fit in the noise that it leaves itself, after some passes with autoregressions of at most `order`.

    The first fit and the last start from all `points`: in the right noise another minimum may lie lower.
    """
    white = reduction.coarse()
    fit = continued(white, best_of(white, points, largest, tolerance), largest, tolerance)
    fit = off_the_plain(white, fit, largest, tolerance)
    noise, evaluations = Autoregression.white(1.0), fit.evaluations
    for number in range(passes):
        noise = noise_left(reduction, fit.point, noise, order, number >= _PLAIN)
        reduction = reduction.growing(noise, fit.point)
        misfit = reduction.misfit(noise, fit.point)
        last = number == passes - 1
        starts = [fit.point, *([*points, *in_contact(fit.point)] if last else [])]
        fit = best_of(misfit, starts, largest, tolerance)
        if reduction.growth and number == _EARLY:
            others = best_of(misfit, _elsewhere(fit.point), largest, tolerance, _GLANCE)
            fit = min(fit, others, key=lambda one: one.slopes.cost)
        evaluations += fit.evaluations
    fit = off_the_plain(misfit, fit, largest, tolerance)
    fit = descend(misfit, fit.point, largest, tolerance, gain=_FINE)
    rows = reduction.prepared(noise, reduction.table(fit.point), CONSTANT)
    return Found(reduction, misfit, fit, noise, rows, evaluations + fit.evaluations)


def _elsewhere(point: Point) -> list[Point]:
    """Other places in a growing gap: at a wrong rate a wrong place looks right, and holds the rate where it is."""
    return [point._replace(place=place) for place in _PLACES]


def noise_left(reduction: Reduction, point: Point, noise: Autoregression, order: int, put: bool) -> Autoregression:
    """The noise in the residual of a fit that was made with a first idea of it.

    A fit takes noise away with every parameter, and most where the gap shows. What it may have taken is put back, as
    as many equally likely series: one standard deviation up and down along every direction of the parameters.
    """
    table = reduction.table(point)
    rows = reduction.prepared(noise, table, CONSTANT)
    shares = least_squares(rows[CONSTANT:], rows[RESIDUAL]).coefficients
    left = table[RESIDUAL] - shares @ table[CONSTANT:]
    if not np.any(left):
        return Autoregression.white(1.0)
    if not put:
        return burg(left[None], order).at_least(reduction.rounding)
    root = least_squares(rows[GAP:], rows[RESIDUAL]).root
    taken = math.sqrt(len(root)) * (root @ table[GAP:])
    return burg(np.vstack([left + taken, left - taken]), order).at_least(reduction.rounding)
