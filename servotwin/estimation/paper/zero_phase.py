"""The noncausal low-pass of section 4.3."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from servotwin.plant.signals import Array

PADDINGS = ("odd", "even")


@dataclass(frozen=True)
class ZeroPhase:
    """A Butterworth low-pass run forwards and backwards: no phase, twice the order in effect (erratum E18).

    Attributes
    ----------
    cutoff : float
        Hz; the two passes together attenuate by 6 dB there.
    order : int
        Of one pass.
    sample_rate : float
        Hz.
    padding : "odd" or "even"
        How the signal goes on beyond its ends: turned about its last sample, or mirrored.
    padding_samples : int
        For how long; less than the signal has.
    """

    cutoff: float
    order: int
    sample_rate: float
    padding: str
    padding_samples: int

    def respond(self, signal: Array) -> Array:
        """(n,) filtered signal (n,)."""
        # Here, because scipy.signal takes long to import and many commands never filter.
        from scipy.signal import sosfiltfilt

        sections = _butterworth(self.order, self.cutoff, self.sample_rate)
        kind = self.padding if self.padding_samples else None
        return np.asarray(sosfiltfilt(sections, signal, padtype=kind, padlen=self.padding_samples))


@lru_cache(maxsize=16)
def _butterworth(order: int, cutoff: float, sample_rate: float) -> Array:
    from scipy.signal import butter

    return np.asarray(butter(order, cutoff, fs=sample_rate, output="sos"))
