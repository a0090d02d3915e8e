"""The residual of the paper's cost with its derivatives, and the spread of a least-squares fit of two parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servotwin.estimation.paper.observer import LagFilter, Observer
from servotwin.hybrid.compiled import compiled
from servotwin.plant.backlash import play_step
from servotwin.plant.signals import Array

_SINGULAR = 1e-7  # of the column's length: what is left of it below this is rounding of the differences


def standard_deviation(sensitivity: Array, nuisance: Array, residual: Array) -> float:
    """Standard deviation of a parameter from the Gauss-Newton information; inf where the window says nothing of it.

    The Schur complement of the information matrix is the squared length of what is left of the parameter's sensitivity
    when its projection on the other's is taken off: never a pseudo-inverse, which would call an unidentifiable
    parameter certain.

    The residual is taken as it is correlated. The variance of its product with what is left is the sum over all lags
    of both their autocovariances, which is the mean square of that product over all shifts of one against the other.

    Parameters
    ----------
    sensitivity, nuisance : (n,) arrays
        Derivatives of the residual by the parameter and by the other one; zeros when it has no effect.
    residual : (n,) array
    """
    square = float(nuisance @ nuisance)
    left = sensitivity - nuisance * (float(nuisance @ sensitivity) / square) if square > 0.0 else sensitivity
    information = float(left @ left)
    if math.sqrt(information) <= _SINGULAR * math.sqrt(float(sensitivity @ sensitivity)):
        return math.inf
    # Here, because scipy.signal takes long to import and many commands never fit.
    from scipy.signal import correlate

    shifted = correlate(residual, left, method="fft")
    return math.sqrt(float(shifted @ shifted) / residual.size) / information


_DIFFERENCE = 2.0**-28  # of the scale: the minimum it finds is off by half of it, and rounding of the cost stays below


@dataclass(frozen=True, eq=False)
class PlayResidual:
    """q3 - q3_hat as a function of the total gap and the screw's first angle, in units of the window's own motion.

    The position's part does not depend on the two and is filtered once. Angles are divided by `scale`, lengths by p
    times `scale`, so that costs, gradients and tolerances are pure numbers: scaling all signals scales the answer.

    Attributes
    ----------
    theta_m : (n,) array
        Motor angle over `scale`.
    base : (n,) array
        Residual of a screw at rest at zero.
    screw : LagFilter
    skip : int
        First sample that counts, k_s.
    scale : float
        rad: the range of the motor's angle.
    unit : float
        m: what a residual of one means.
    variation : float
        Standard deviation of the position over `unit`.
    """

    theta_m: Array
    base: Array
    screw: LagFilter
    skip: int
    scale: float
    unit: float
    variation: float

    @classmethod
    def of(
        cls, theta_m: Array, position: Array, sample_rate: float, plant: Observer, pitch: float, skip: int
    ) -> PlayResidual:
        """Prepare the residual of theta_m (n,) rad and position (n,) m; `pitch` (m/rad) only sets the unit."""
        scale = float(np.ptp(theta_m))
        unit = pitch * scale
        screw = plant.screw_filter(sample_rate)
        base = plant.position_filter(sample_rate).respond(position / unit)
        lags = LagFilter(screw.decay, screw.taps / pitch)
        return cls(theta_m / scale, base, lags, skip, scale, unit, float(np.std(position)) / unit)

    def values(self, point: Array) -> Array:
        """(n - skip,) residual at (gap, theta_d0) over `scale`.

        A negative gap mirrors the screw's motion at the motor's: the screw then leads, and the cost stays smooth
        through zero, which an unconstrained minimiser needs.
        """
        return self._whole(point)[self.skip :]

    def _whole(self, point: Array) -> Array:
        gap, start = float(point[0]), float(point[1])
        residual = self.base.copy()
        if gap >= 0.0:
            self.screw.subtract_play(self.theta_m, 0.5 * gap, start, residual)
            return residual
        # The play of a negative gap: the mirror of the screw's motion at the motor's, computed with the positive one.
        mirrored = 2.0 * float(self.theta_m[0]) - start
        self.screw.subtract_play(self.theta_m, -0.5 * gap, mirrored, residual)
        return 2.0 * self._no_gap - residual

    @cached_property
    def _no_gap(self) -> Array:
        residual = self.base.copy()
        self.screw.subtract_play(self.theta_m, 0.0, 0.0, residual)
        return residual

    def cost(self, point: Array) -> float:
        """Mean square of `values`."""
        return mean_square(self._whole(point), self.skip)

    def slope(self, point: Array) -> tuple[float, Array]:
        """Cost and its gradient (2,) by forward differences."""
        cost = self.cost(point)
        return cost, np.array([(self.cost(point + step) - cost) / step.sum() for step in self._steps(point)])

    def sensitivities(self, point: Array) -> tuple[Array, Array]:
        """Derivatives of `values` by gap and theta_d0, (n - skip,) each: zeros where there is no effect."""
        values = self.values(point)
        by_gap, by_start = ((self.values(point + step) - values) / step.sum() for step in self._steps(point))
        return by_gap, by_start

    def _steps(self, point: Array) -> tuple[Array, Array]:
        """Steps in gap and theta_d0; the second towards theta_m[0], because outside the gap theta_d0 has no effect."""
        inwards = math.copysign(_DIFFERENCE, float(self.theta_m[0]) - float(point[1]))
        return np.array([_DIFFERENCE, 0.0]), np.array([0.0, inwards])

    def unexplained(self, cost: float) -> float:
        """Residual over the position's own variation (rms both): near 1 when the model explains nothing."""
        return math.sqrt(cost) / self.variation if self.variation > 0.0 else math.inf

    def first_screw_angle(self, gap: float, point: Array) -> float:
        """Screw angle (rad) at the first sample: that of `point`, clamped into the gap (rad); NaN if that is."""
        angle, first = self.scale * float(point[1]), self.scale * float(self.theta_m[0])
        return math.nan if math.isnan(gap) else min(max(angle, first - 0.5 * gap), first + 0.5 * gap)

    def screw_motion(self, point: Array) -> tuple[float, float, float]:
        """Return the angles (rad) of the screw's pushes forwards and backwards, and of motion without a push.

        All of it where the cost counts, after k_s.
        """
        half, start = 0.5 * max(0.0, float(point[0])), float(point[1])
        forwards, backwards, free = screw_motion(self.theta_m, half, start, self.skip)
        return self.scale * forwards, self.scale * backwards, self.scale * free


@compiled
def mean_square(values: Array, skip: int) -> float:
    """Mean square of the samples from `skip` on."""
    total = 0.0
    for i in range(skip, values.size):
        total += values[i] * values[i]
    return total / (values.size - skip)


@compiled
def screw_motion(theta_m: Array, half: float, start: float, skip: int) -> tuple[float, float, float]:
    """Return, after sample `skip`, the travel of the screw up and down and the range of the motor's lead."""
    w = play_step(start, theta_m[0], half)
    upward = downward = 0.0
    lowest, highest = math.inf, -math.inf
    for i in range(1, theta_m.size):
        new = play_step(w, theta_m[i], half)
        if i > skip:
            upward += max(0.0, new - w)
            downward += max(0.0, w - new)
            lowest = min(lowest, theta_m[i] - new)
            highest = max(highest, theta_m[i] - new)
        w = new
    return upward, downward, max(0.0, highest - lowest)
