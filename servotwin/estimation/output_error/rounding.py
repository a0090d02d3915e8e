"""Effect of the encoders' rounding on a fit: samples that show the same count have the same error."""

from __future__ import annotations

import numpy as np

from servotwin.estimation.output_error.fit import Search
from servotwin.plant.signals import Array


def per_count(found: Search, weights: Array) -> Array:
    """(k, r) sums of weights of the whitened residual (k, m), back on the samples, over those of each count."""
    problem, data = found.problem, found.best.raw.size
    # Back from the whitened residual to the samples: the whitening filter, transposed.
    filtered = [np.convolve(row[::-1], found.noise.predictors[-1])[:data][::-1] for row in weights]
    margin = (problem.position.size - data) // 2
    begins = np.flatnonzero(np.diff(problem.position[margin : margin + data])) + 1
    sums = np.add.reduceat(np.array(filtered), np.concatenate([[0], begins]), axis=1)
    return np.asarray(sums / found.noise.spread[-1])
