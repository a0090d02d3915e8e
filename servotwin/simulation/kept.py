"""What the sampled loop keeps: its samples, all of a horizon or the last ones of a run without an end, and the noise
drawn for ticks to come."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import NoiseSource
from servotwin.simulation.ticks import Output


def new_output(rows: int, samples: int, tick_every: int, record_every: int) -> Output:
    """Room for so many samples of `rows` states, and for their ticks."""
    ticks = -(-((samples - 1) * record_every + 1) // tick_every)
    return Output(np.empty((rows, samples)), np.empty(ticks), np.empty(ticks, dtype=np.int8), 0, 0)


def moved_on(output: Output, sample: int, tick_every: int, record_every: int) -> Output:
    """The same room for samples from `sample` on; what is recorded of them stays, the rest is forgotten."""
    tick = sample * record_every // tick_every
    for values, by in (
        (output.states, sample - output.first_sample),
        (output.measured, tick - output.first_tick),
        (output.active, tick - output.first_tick),
    ):
        values[..., : values.shape[-1] - by] = values[..., by:].copy()
    return output._replace(first_sample=sample, first_tick=tick)


@dataclass
class Draws:
    """Noise for tick after tick, drawn at least `ahead` values at a time: into what blocks changes nothing."""

    source: NoiseSource | None
    ahead: int
    drawn: Array = field(default_factory=lambda: np.zeros(0))

    def take(self, count: int) -> Array:
        """Noise (m) of the next ticks."""
        if self.source is None:
            return np.zeros(count)
        if (missing := count - self.drawn.size) > 0:
            self.drawn = np.concatenate([self.drawn, self.source.block(max(missing, self.ahead))])
        values, self.drawn = self.drawn[:count], self.drawn[count:]
        return values

    def put_back(self, values: Array) -> None:
        """What was taken for ticks that are still to come."""
        if self.source is not None:
            self.drawn = np.concatenate([values, self.drawn])
