"""The linear state observer of the paper's Appendix, for any number of masses, with errata E5 and E6 corrected.

It rebuilds the last mass's position q3 from the screw's angle theta_d and the measured q3, whatever the state at the
start of a window was: what it does not know of that state dies out like exp(-alpha t).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from servotwin.errors import InvalidInput
from servotwin.estimation.paper.lags import LagFilter
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import transfer


@dataclass(frozen=True, eq=False)
class Observer:
    """x_hat' = A x_hat + B theta_d + L q3, q3_hat = x_hat[0] (Eq A.4 with A = A_L).

    With a rigid screw there are N = 2 (n - 1) states.

    Attributes
    ----------
    numerator, denominator : (N,) and (N + 1,) arrays
        G2 (Eq 13) in ascending powers of s, the denominator monic: b and a of Eqs A.2 and A.3.
    alpha : float
        rad/s; every eigenvalue of A is -alpha.
    """

    numerator: Array
    denominator: Array
    alpha: float

    @property
    def order(self) -> int:
        """Number of states, N."""
        return self.denominator.size - 1

    @property
    def static_gain(self) -> float:
        """q3 over theta_d at rest, m/rad."""
        return float(self.numerator[0] / self.denominator[0])

    @property
    def A_o(self) -> Array:
        """(N, N) plant in observable canonical form (Eq A.1)."""
        return _companion(self.denominator)

    @property
    def B(self) -> Array:
        """(N,) column of theta_d (Eq A.1)."""
        return np.append(np.zeros(self.order - self.numerator.size), self.numerator[::-1])

    @property
    def C(self) -> Array:
        """(N,) row of the output (Eq A.1)."""
        return np.eye(self.order)[0]

    @property
    def L(self) -> Array:
        """(N,) gains, l_(N-1) first: l_i = C(N, N - i) alpha^(N - i) - a_i (Eq A.9 prints alpha^i: erratum E6)."""
        return (self._characteristic - self.denominator)[-2::-1]

    @property
    def A(self) -> Array:
        """(N, N) A_L = A_o - L C; row 2 begins with -(a_2 + l_2) (Eq A.7 prints a_3: erratum E5)."""
        return _companion(self._characteristic)

    @property
    def _characteristic(self) -> Array:
        """(N + 1,) of (s + alpha)^N, ascending (Eq A.6)."""
        powers = range(self.order + 1)
        return np.array([math.comb(self.order, i) * self.alpha ** (self.order - i) for i in powers])

    def initial_state(self, derivatives: Array) -> Array:
        """(N,) state of the plant whose output begins with (y, y', y'', ...), theta_d resting at zero (erratum E9)."""
        rows = [self.C]
        while len(rows) < self.order:
            rows.append(rows[-1] @ self.A_o)
        return np.asarray(np.linalg.solve(np.array(rows), derivatives))

    def error(self, state: Array, times: Array) -> Array:
        """(n,) error q3 - q3_hat at `times` (s) when the plant starts from `state` and the observer from zero (Eq A.5).

        e(0) = x(0) holds only for x_hat(0) = 0 (erratum E7).
        """
        return np.asarray(expm(self.A * np.asarray(times)[:, None, None])[:, 0] @ state)

    def estimate(self, theta_d: Array, position: Array, sample_rate: float) -> Array:
        """(n,) q3_hat from samples of theta_d (rad) and q3 (m), exact where they are linear between samples.

        The observer starts at rest one sample before the first.
        """
        from_position = LagFilter.sampled(
            self._characteristic - self.denominator, self.order, self.alpha, 1.0 / sample_rate
        )
        return self.screw_filter(sample_rate).respond(theta_d) + from_position.respond(position)

    def screw_filter(self, sample_rate: float) -> LagFilter:
        """numerator / (s + alpha)^N: what theta_d adds to q3_hat."""
        return LagFilter.sampled(self.numerator, self.order, self.alpha, 1.0 / sample_rate)

    def position_filter(self, sample_rate: float) -> LagFilter:
        """denominator / (s + alpha)^N: what q3 adds to the residual q3 - q3_hat."""
        return LagFilter.sampled(self.denominator, self.order, self.alpha, 1.0 / sample_rate)


def observer(servo: Servo, alpha: float = 40.0) -> Observer:
    """The observer of a servo with every pole at -alpha (rad/s).

    Raises
    ------
    InvalidInput
        alpha is not a finite number above zero.
    """
    if not (math.isfinite(alpha) and alpha > 0.0):
        raise InvalidInput(f"observer alpha = {alpha!r} rad/s: must be finite and greater than 0")
    numerator, denominator, _ = transfer(servo.masses, servo.stiffnesses, servo.dampings, servo.k_d)
    lead = denominator[-1]
    return Observer(servo.p * numerator / lead, denominator / lead, float(alpha))


def _companion(characteristic: Array) -> Array:
    """(N, N) observable canonical form of a monic polynomial (N + 1,), ascending (Eq A.1)."""
    order = characteristic.size - 1
    matrix = np.eye(order, k=1)
    matrix[:, 0] = -characteristic[-2::-1]
    return matrix
