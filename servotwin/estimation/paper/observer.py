"""The observer of the paper's Appendix, and the filters with all poles at -alpha that it is made of.

Such a filter is a polynomial in the lag alpha / (s + alpha). It runs as a cascade of equal first-order lags whose
outputs are weighted and added. Unlike the canonical forms with their binomial coefficients, it loses no digits, however
small alpha times the sample interval is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial as poly
from scipy.linalg import expm

from servotwin.errors import InvalidInput
from servotwin.hybrid.compiled import compiled
from servotwin.plant.backlash import play_step
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import transfer

STAGES = 4  # lags that one pass over the samples takes; with three masses the observer has four


@dataclass(frozen=True, eq=False)
class LagFilter:
    """A sampled filter: the sum of taps[k] z_k, where z_0 is the input and z_k the exponential average of z_(k-1).

    Attributes
    ----------
    decay : float
        1 - exp(-alpha T): what one step takes off the distance between an average and its input.
    taps : (n + 1,) array
    """

    decay: float
    taps: Array

    @classmethod
    def sampled(cls, numerator: Array, order: int, alpha: float, interval: float) -> LagFilter:
        """numerator(s) / (s + alpha)^order, exact for an input that is linear between its samples.

        The filter starts at rest with its input zero one sample before the first.

        Parameters
        ----------
        numerator : (m,) array
            Ascending powers of s, m <= order + 1.
        order : int
        alpha : float
            rad/s.
        interval : float
            Sample interval, s.
        """
        weights = lag_polynomial(numerator, order, alpha)
        transition, now, after = _first_order_hold(order, alpha, interval)
        decay = -float(np.expm1(-alpha * interval))
        nilpotent = transition - (1.0 - decay) * np.eye(order)
        taps, column = [weights[0] + weights[1:] @ after], now + transition @ after
        for _ in range(order):
            column = column / decay
            taps.append(weights[1:] @ column)
            column = nilpotent @ column
        return cls(decay, np.array(taps))

    def respond(self, signal: Array) -> Array:
        """(n,) response to the samples of `signal` (n,)."""
        residual = np.zeros(signal.size)
        self.subtract_play(signal, 0.0, 0.0, residual)
        return -residual

    def subtract_play(self, signal: Array, half: float, start: float, residual: Array) -> None:
        """Take the filtered output of a play operator off `residual`, in place.

        Its half gap is `half`, its output before the first sample `start`. Later passes filter the first one's
        output: a play without gap passes its input on unchanged.
        """
        # Read-only or strided signals would be compiled once more.
        carried, signal = np.empty(signal.size), np.require(signal, requirements=("C", "W"))
        for taps in self._sections():
            subtract_section(signal, half, start, self.decay, taps, residual, carried)
            signal, half = carried, 0.0

    def _sections(self) -> Array:
        """(passes, STAGES + 1) taps of each pass; those after the first have no direct term."""
        passes = max(1, -(-(self.taps.size - 1) // STAGES))
        lagged = np.zeros(passes * STAGES)
        lagged[: self.taps.size - 1] = self.taps[1:]
        direct = np.zeros((passes, 1))
        direct[0] = self.taps[0]
        return np.hstack([direct, lagged.reshape(passes, STAGES)])


def lag_polynomial(numerator: Array, order: int, alpha: float) -> Array:
    """(order + 1,) weights of the powers of alpha / (s + alpha) that make up numerator(s) / (s + alpha)^order.

    With s = alpha (1 - l) / l, each s^j / (s + alpha)^order is alpha^(j - order) l^(order - j) (1 - l)^j.
    """
    weights = np.zeros(order + 1)
    for power, coefficient in enumerate(numerator):
        falling = np.asarray(poly.polypow([1.0, -1.0], power))
        weights[order - power :] += coefficient * alpha ** float(power - order) * falling
    return weights


@lru_cache(maxsize=64)
def _first_order_hold(order: int, alpha: float, interval: float) -> tuple[Array, Array, Array]:
    """x[k+1] = F x[k] + now u[k] + after u[k+1] of the cascade of `order` lags, for u linear in between.

    Cached, because it is the same in every window and LAPACK's threads can lose milliseconds over it on a busy machine.
    """
    augmented = np.zeros((order + 2, order + 2))
    augmented[:order, :order] = alpha * interval * (np.eye(order, k=-1) - np.eye(order))
    augmented[0, order] = alpha * interval
    augmented[order, order + 1] = 1.0
    step = expm(augmented)
    return step[:order, :order], step[:order, order] - step[:order, order + 1], step[:order, order + 1]


@compiled
def subtract_section(
    signal: Array, half: float, start: float, decay: float, taps: Array, residual: Array, carried: Array
) -> None:
    """Play operator and four lags in one pass: `residual` loses their weighted sum, `carried` gets the last lag.

    `carried` may be `signal`: a sample is read before it is written.
    """
    direct, first, second, third, fourth = taps[0], taps[1], taps[2], taps[3], taps[4]
    w = start
    a = b = c = d = 0.0
    for i in range(signal.size):
        w = play_step(w, signal[i], half)
        residual[i] -= direct * w + first * a + second * b + third * c + fourth * d
        carried[i] = d
        d += decay * (c - d)
        c += decay * (b - c)
        b += decay * (a - b)
        a += decay * (w - a)


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
