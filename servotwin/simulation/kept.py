"""Where the sampled loop records: all samples of a horizon, or the last ones of a run without an end."""

from __future__ import annotations

import numpy as np

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
