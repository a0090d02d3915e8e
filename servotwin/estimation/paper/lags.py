"""Filters with all their poles at -alpha, as polynomials in the lag alpha / (s + alpha).

Such a filter runs as a cascade of equal first-order lags whose outputs are weighted and added. Unlike the canonical
forms with their binomial coefficients, it loses no digits, however small alpha times the sample interval is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial as poly
from scipy.linalg import expm

from servotwin.hybrid.compiled import compiled
from servotwin.plant.backlash import play_step
from servotwin.plant.signals import Array

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

        Its half gap is `half`, its output before the first sample `start`. Later passes filter what the first one put
        out: a play without gap passes its input on unchanged.
        """
        carried = np.empty_like(signal)
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

    Kept, because it is the same in every window, and LAPACK's threads can lose milliseconds over it on a busy machine.
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
