"""Quick fit of a window in a fraction of a millisecond: the plain fit at a low rate, with its spread.

It tells whether the gap has moved; the estimator tells where to. It needs the gap as known before, next to which it
searches, and the encoder's offset, without which a window of one contact shows nothing of the gap. Where the offset is
not known, several places of the screw in the gap are tried. A machine that was learnt is fitted as learnt; what is
still open of its numbers is computed on demand, because few windows need it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.least_squares import least_squares, project_out, remove
from servotwin.estimation.core.response import Response, response
from servotwin.estimation.core.variants import variants
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.whitened.nearby import nearby
from servotwin.estimation.whitened.reduction import Misfit, MisfitSlopes, NuisancePrior, Point, Reduction, factor_for
from servotwin.estimation.whitened.search import GAP_ONLY, descend
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

PLACES = (-1.0, -0.6, -0.2, 0.2, 0.6, 1.0)
STEPS = 16
_FREE, _PRECISION, _GAIN = 2.0, 1e-5, 1e-7  # ranges of the motor; of the motor's range; of the cost
_LAST_STEP, _CLOSE = 0.3, 1e-5  # largest last step of a converged gap: standard deviations; of the motor's range
_FLAT = 1e-9  # of the derivative's square: below it nothing shows the gap
_MACHINES = 16_384
"""Learnt machines whose responses are kept, at 2 kB: a fifth of a glance, and they stay the same until an estimate."""
_ANYWHERE = 1.0 / 3.0  # variance of a place of which nothing is known, from -1 to 1


class MachineSpread(NamedTuple):
    """Effect of a machine's open numbers on a fit: spread of the gap (rad), root mean square left over (m)."""

    gap: float
    misfit: float


NO_SPREAD = MachineSpread(0.0, 0.0)
"""Of an exact model."""


@dataclass(frozen=True, eq=False)
class _LearntMinimum:
    """A minimum on a learnt machine, and by how much the gap moves there per change of each sample."""

    reduction: Reduction
    misfit: Misfit
    servo: Servo
    machine: FactorPrior
    point: Point
    weights: Array

    def spread(self) -> MachineSpread:
        """Effect of one standard deviation along each axis of the open numbers."""
        reduction, basis = self.reduction, self.misfit.basis
        screw = reduction.traced(self.point)[:1]
        answer = reduction.reduced.respond(screw)[0]
        shares = least_squares(reduction.fixed(), self.misfit.position - answer).coefficients
        rate, factors = 1.0 / reduction.response.interval, tuple(self.machine.mean.tolist())
        near = nearby(self.servo, factors, rate, reduction.decimation, soft=False)
        motions = np.linalg.cholesky(self.machine.covariance).T @ near.motions(screw, answer, shares[1:])
        remainder, count = project_out(basis, motions), _freedom(self.misfit)
        return MachineSpread(
            float(np.linalg.norm(motions @ self.weights)), float(np.linalg.norm(remainder)) / count**0.5
        )


@dataclass(frozen=True)
class QuickFit:
    """Minimum next to a gap.

    Attributes
    ----------
    gap : float
        rad, total.
    std : float
        rad: spread for noise coloured like the residual, for the offset's stated spread and `least`; inf where nothing
        shows the gap.
    misfit : float
        m, root mean square of the residual.
    converged : bool
        True where the gap would move no more; the place may still move along a valley that does not change the gap.
    least : float
        rad: the part of `std` that every window has.
    """

    gap: float
    std: float
    misfit: float
    converged: bool
    least: float = 0.0
    _learnt: _LearntMinimum | None = field(default=None, repr=False, compare=False)

    @property
    def noise_std(self) -> float:
        """Spread (rad) without the part that every window has."""
        return math.sqrt(max(0.0, self.std**2 - self.least**2))

    def machine_spread(self) -> MachineSpread:
        """Effect of what is open of the machine; none on an exact model."""
        return NO_SPREAD if self._learnt is None else self._learnt.spread()


def quick_fit(
    window: Window,
    servo: Servo,
    gap: float,
    offset: tuple[float, float] | None = None,
    machine: FactorPrior | None = None,
) -> QuickFit:
    """Fit a window with theta_m next to a total gap (rad).

    Parameters
    ----------
    window : Window
    servo : Servo
    gap : float
    offset : (float, float), optional
        Mean and standard deviation (rad) of the encoder's offset as earlier windows showed it; None: not known.
    machine : FactorPrior, optional
        The machine's numbers over the servo's, as learnt; None: the servo is exact.
    """
    reduction = _slow(window, servo, offset, machine)
    misfit, span = reduction.coarse(), float(np.ptp(reduction.theta_m))
    costs = misfit.costs([Point(gap, place) for place in PLACES])
    start = Point(gap, PLACES[int(np.argmin(costs))])
    both = descend(misfit, start, _FREE * span, _PRECISION * span, STEPS, gain=_GAIN)
    # Where noise hides the place, its steps are wild and keep the gap from its minimum.
    fit = descend(misfit, both.point, _FREE * span, _PRECISION * span, STEPS, GAP_ONLY, gain=_GAIN)
    rms, residual = math.sqrt(fit.slopes.cost / _freedom(misfit)), fit.slopes.residual
    weights = _weights(fit.slopes, rms)
    if weights is None:
        return QuickFit(float(fit.point.gap), math.inf, rms, fit.converged)
    by_place = float(weights @ fit.slopes.jacobian[1])
    variance = _coloured(weights, residual) + _ANYWHERE * by_place**2
    if offset is not None:
        variance += (offset[1] * _by_offset(reduction, misfit, weights)) ** 2
    std = math.sqrt(variance)
    still = abs(float(weights @ residual))
    learnt = None if machine is None else _LearntMinimum(reduction, misfit, servo, machine, fit.point, weights)
    return QuickFit(float(fit.point.gap), std, rms, still <= max(_LAST_STEP * std, _CLOSE * span), 0.0, learnt)


def _freedom(misfit: Misfit) -> int:
    """Degrees of freedom of the residual."""
    return max(1, misfit.position.size - len(misfit.basis) - 2)


def _slow(window: Window, servo: Servo, offset: tuple[float, float] | None, machine: FactorPrior | None) -> Reduction:
    """Decimate both channels to the rate that the structure needs."""
    assert window.theta_m is not None
    angle, position = window.theta_m, window.position
    reduce = decimation(factor_for(response(servo, window.sample_rate), angle.size))
    rows = reduce.rows(np.vstack([angle - angle[0], position - position[0]]))
    rate = window.sample_rate / reduce.factor
    model = response(servo, rate) if machine is None else _learnt_response(servo, tuple(machine.mean.tolist()), rate)
    if offset is None:
        return Reduction.of(rows[0], rows[1], model, skew=False, factor=1)
    first, home = float(angle[0] + rows[0, 0]), float(position[0] + rows[1, 0])
    gain = model.static_gain
    known = NuisancePrior(gain * (first + offset[0]) - home, abs(gain) * offset[1])
    return Reduction.of(rows[0], rows[1], model, known, skew=False, factor=1)


@lru_cache(maxsize=_MACHINES)
def _learnt_response(servo: Servo, factors: tuple[float, ...], rate: float) -> Response:
    """Response of a servo with other logarithms of its factors, at a sample rate (Hz)."""
    return variants(servo, [np.array(factors)], rate)[0]


def _weights(slopes: MisfitSlopes, rms: float) -> Array | None:
    """(m,) by how much the gap moves per change of each sample; None: nothing shows the gap.

    The place lies within the gap; where the noise (m rms) hides it, only that is known of it.
    """
    by_gap, by_place = slopes.jacobian
    known = float(by_place @ by_place) + rms * rms / _ANYWHERE
    remainder = by_gap - (float(by_gap @ by_place) / known) * by_place if known > 0.0 else by_gap
    size = float(remainder @ by_gap)
    return remainder / size if size > _FLAT * float(by_gap @ by_gap) else None


def _by_offset(reduction: Reduction, misfit: Misfit, weights: Array) -> float:
    """Change of the gap per change of the encoder's offset."""
    constant = np.full(weights.size, reduction.response.static_gain)
    remove(misfit.basis, len(misfit.basis), constant)
    return float(weights @ constant)


def _coloured(weights: Array, noise: Array) -> float:
    """Variance of the weighted sum (n,) of noise with the spectrum of one series (n,) of it."""
    count = weights.size
    size = 1 << (2 * count - 1).bit_length()  # at least twice as long, so that no end meets the other
    gains, powers = np.abs(np.fft.rfft([weights, noise], size)) ** 2
    both = gains * powers
    return (2.0 * float(both.sum()) - float(both[0] + both[-1])) / (count * size)
