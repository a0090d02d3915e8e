"""Noise of the position sensor: Gaussian, white or high-passed, with a stated standard deviation (section 4.3).

scipy.signal takes most of a second to import, so only what draws noise imports it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array

PASSBAND_RIPPLE_DB = 1.0
STOPBAND_ATTENUATION_DB = 40.0


@settings("noise")
@dataclass(frozen=True)
class Noise:
    """Stationary Gaussian noise.

    A `band` of 10 and 50 Hz, the paper's, gives a Butterworth filter of fourth order near 42 Hz. The paper's noise has
    a standard deviation of 0.22 mm; its "20 dB" is another number (erratum E13).

    Raises
    ------
    InvalidInput
        std is negative or not finite, the band is not 0 < stop < pass, or the kind is unknown.
    """

    std: Annotated[float, key("std_mm", "std_deg", minimum=0.0, help="Standard deviation of the filtered noise.")]
    band: Annotated[
        tuple[float, float],
        key(
            "band_hz",
            above=0.0,
            ordered=True,
            help="Stop and pass edge of the high-pass: at least 40 dB down below the first, at most 1 dB above the "
            "second (erratum E18); not used by white noise.",
        ),
    ] = (10.0, 50.0)
    kind: Annotated[Literal["highpass", "white"], key(choices=("highpass", "white"), help="Spectrum.")] = "highpass"

    def __post_init__(self) -> None:
        check(self)
        stop, passed = self.band
        if not stop < passed:
            raise InvalidInput(f"noise band = {self.band} Hz: must be stop < pass")

    def filter(self, rate: float) -> Array:
        """(sections, 6) second-order sections of unit noise gain at a sample rate (Hz)."""
        if self.kind == "white":
            return np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
        stop, passed = self.band
        if not passed < 0.5 * rate:
            raise InvalidInput(
                f"noise band = {self.band} Hz: the pass edge must be below half the sample rate of {rate} Hz"
            )
        return _high_pass(stop, passed, rate).copy()

    def source(self, rate: float, rng: np.random.Generator) -> NoiseSource:
        """A source of consecutive blocks, stationary from its first sample."""
        # Of noise of any size: the filter's state does not depend on it.
        root = _start_root(Noise(1.0, (self.band[0], self.band[1]), self.kind), rate)
        start = root @ rng.standard_normal(len(root))
        return NoiseSource(self.std, self.filter(rate), start.reshape(-1, 2), rng)

    def samples(self, n: int, rate: float, rng: np.random.Generator) -> Array:
        """(n,) m, the first n samples of `source`.

        Parameters
        ----------
        n : int
        rate : float
            Hz, sample rate.
        rng : numpy.random.Generator
            The only randomness used.
        """
        return self.source(rate, rng).block(n)


@lru_cache(maxsize=64)
def _high_pass(stop: float, passed: float, rate: float) -> Array:
    """Sections of a filter of unit noise gain; all are Hz."""
    from scipy import signal

    order, edge = signal.buttord(passed, stop, PASSBAND_RIPPLE_DB, STOPBAND_ATTENUATION_DB, fs=rate)
    sections: Array = signal.butter(order, edge, "highpass", output="sos", fs=rate)
    sections[0, :3] /= noise_gain(sections)
    return sections


@lru_cache(maxsize=64)
def _start_root(noise: Noise, rate: float) -> Array:
    """A square root of the stationary covariance of a filter's state."""
    A, B, _, _ = state_space(noise.filter(rate))
    return _square_root(_covariance(A, B))


@dataclass
class NoiseSource:
    """Filter, state and generator of noise drawn in blocks; the block sizes do not change its values."""

    std: float
    sections: Array
    state: Array
    rng: np.random.Generator

    def block(self, n: int) -> Array:
        """(n,) m, the next n samples."""
        from scipy import signal

        if n == 0:
            return np.zeros(0)
        out, self.state = signal.sosfilt(self.sections, self.rng.standard_normal(n), zi=self.state)
        return np.asarray(self.std * out)


def noise_gain(sections: Array) -> float:
    """Standard deviation of the filter's output for unit white noise: sqrt of the sum of its squared impulse response.

    In closed form: C P C' + D^2 with P the solution of the discrete Lyapunov equation P = A P A' + B B'.
    """
    A, B, C, D = state_space(sections)
    return float(np.sqrt(C @ _covariance(A, B) @ C + D * D))


def state_space(sections: Array) -> tuple[Array, Array, Array, float]:
    """(A, B, C, D) of a cascade of second-order sections, whose state is that of `scipy.signal.sosfilt`."""
    size = 2 * len(sections)
    A, B, C, D = np.zeros((size, size)), np.zeros(size), np.zeros(size), 1.0
    for i, (b0, b1, b2, _, a1, a2) in enumerate(sections):
        own = slice(2 * i, 2 * i + 2)
        drive = np.array([b1 - a1 * b0, b2 - a2 * b0])
        A[own] = np.outer(drive, C)
        A[own, own] = [[-a1, 1.0], [-a2, 0.0]]
        B[own] = drive * D
        C, D = b0 * C, b0 * D
        C[2 * i] = 1.0
    return A, B, C, D


def _covariance(A: Array, B: Array) -> Array:
    """P = A P A' + B B', the stationary covariance of the state driven by unit white noise."""
    from scipy.linalg import solve_discrete_lyapunov

    return np.asarray(solve_discrete_lyapunov(A, np.outer(B, B)))


def _square_root(covariance: Array) -> Array:
    """A square root of a symmetric positive semidefinite matrix."""
    # Not Cholesky's: white noise has the covariance zero, which is not definite.
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
