"""The model of one mass on a rigid screw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servotwin.estimation.output_error.models import Motion, Priors, Unknown, common, independent
from servotwin.hybrid.compiled import bare
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play_samples
from servotwin.plant.signals import Array

LAG = 5  # place among the unknowns
_CONSTANT = np.ones(1)  # size of a gap that stays as it is


@dataclass(frozen=True)
class PlayModel:
    """One mass on a rigid screw: the play operator, and the lag of its encoder."""

    axis: Axis
    priors: Priors

    @property
    def speed(self) -> float:
        """No observer."""
        return 0.0

    @property
    def slowing(self) -> tuple[float, float]:
        """Any."""
        return 1.0, 1.0

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Half gap, offset of the position, delay, ratio, first place of the screw, lag of the position.

        Both encoders' electronics delay, and filter: a lag that is not fitted is taken for gap and delay.
        """
        return (
            *common(self.priors),
            Unknown("first place", math.inf, "load", first=True),
            Unknown("lag", self.priors.delay, "time", positive=True),
        )

    @cached_property
    def root(self) -> Array:
        """(u, u), diagonal."""
        return independent(self.unknowns)

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) for a first position of the mass."""
        return np.array([half, offset, 0.0, 0.0, first[0], 0.0])

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """Motion under the motor's motion (N,) at the load, for unknowns (u,); there is nothing to observe."""
        del measured, rate
        driven, half, place = self._driven(drive, values)
        lead, lag = driven - place, float(values[LAG])
        sides = np.where(np.abs(lead) >= half * (1.0 - 1e-9), np.sign(lead), 0.0).astype(np.int8)
        return Motion(lagged(place, lag / interval), np.gradient(place, interval), place, sides)

    def position(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Array:
        """Position (N,) of the mass in `simulate`."""
        del measured, rate
        return self.position_in_growing_gap(drive, interval, values, _CONSTANT)

    def position_in_growing_gap(self, drive: Array, interval: float, values: Array, sizes: Array) -> Array:
        """Position (N,) of the mass in a gap that changes: `sizes` (N,) or (1,) times the one of `values` (u,)."""
        return lagged(self._driven(drive, values, sizes)[2], float(values[LAG]) / interval)

    def _driven(self, drive: Array, values: Array, sizes: Array = _CONSTANT) -> tuple[Array, float, Array]:
        """Motor (N,) at the load, half gap there, and place (N,) of the screw behind a gap of `sizes` (N,) or (1,)."""
        half, offset, _, ratio, first, _ = values.tolist()
        driven, half = math.exp(ratio) * drive + offset, math.exp(ratio) * abs(half)
        return driven, half, play_samples(driven, half * sizes, first)


def lagged(values: Array, samples: float) -> Array:
    """A signal (N,) behind a first-order lag of a number of samples, straight between them; itself without a lag."""
    if not samples > 0.0:
        return values
    out, decay = np.empty(values.size), math.exp(-1.0 / samples)
    slope = samples * (1.0 - decay)
    out[0] = values[0]
    lag(values, decay, 1.0 - slope, slope - decay, out)
    return out


@bare
def lag(values: Array, decay: float, now: float, before: float, out: Array) -> None:
    """`lagged` into `out` (N,), of which the first is there."""
    for i in range(1, values.size):
        out[i] = decay * out[i - 1] + now * values[i] + before * values[i - 1]
