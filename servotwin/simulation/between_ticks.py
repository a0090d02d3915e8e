"""Readings of the position sensor at samples between the ticks of a slow controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import NoiseSource
from servotwin.simulation.inputs import quantised
from servotwin.simulation.readings import Readings

_BLOCK = 4096


@dataclass
class BetweenTicks:
    """Readings between ticks, where a step of the simulation is a sample; the controller gets none of them.

    Attributes
    ----------
    late : int
        Samples by which they are late.
    resolution : float
        One count, m; 0: ideal.
    readings : Readings, optional
        Errors of the encoder.
    noise : NoiseSource, optional
        Added to them: draws of their own, so that a finer record changes no motion.
    """

    late: int
    resolution: float
    readings: Readings | None
    noise: NoiseSource | None
    _drawn: Array = field(default_factory=lambda: np.zeros(0))
    _first: int = 0

    def read(self, samples: NDArray[np.int64], sensed: Callable[[int, int], Array]) -> Array:
        """(n,) m, at ascending samples; `sensed` gives what the sensor sees from a sample up to another one."""
        steps = np.maximum(samples - self.late, 0)
        errors = np.zeros(steps.size) if self.readings is None else self.readings.position.at(steps)
        if self.noise is not None:
            # A late encoder shows its start, without noise, until the first reading arrives.
            errors = errors + np.where(samples < self.late, 0.0, self._noise_at(self.noise, steps))
        return quantised(sensed(steps[0], steps[-1] + 1)[steps - steps[0]] + errors, self.resolution)

    def forget(self, step: int) -> None:
        """Drop the noise that was drawn for steps before one."""
        if step - self._first <= self._drawn.size:
            self._drawn, self._first = self._drawn[step - self._first :], step

    def _noise_at(self, source: NoiseSource, steps: NDArray[np.int64]) -> Array:
        """Noise (m) at steps; each is drawn once, in turn."""
        if (missing := int(steps[-1]) + 1 - self._first - self._drawn.size) > 0:
            self._drawn = np.concatenate([self._drawn, source.block(max(missing, self._drawn.size, _BLOCK))])
        return self._drawn[steps - self._first]
