"""Effect of the encoders' rounding on a fit: samples that show the same count have the same error."""

from __future__ import annotations

import numpy as np

from servotwin.estimation.output_error.fit import Search
from servotwin.plant.signals import Array


def on_samples(found: Search, weights: Array) -> Array:
    """(k, m) weights of the residual that weights of the whitened one (k, m) stand for."""
    # The whitening filter, transposed.
    filtered = [np.convolve(row[::-1], found.noise.predictors[-1])[: row.size][::-1] for row in weights]
    return np.asarray(np.array(filtered) / found.noise.spread[-1])


def per_count(found: Search, weights: Array) -> Array:
    """(k, r) sums of weights of the whitened residual (k, m), back on the samples, over those of each count."""
    position, data = found.problem.position, weights.shape[1]
    margin = (position.size - data) // 2
    begins = np.flatnonzero(np.diff(position[margin : margin + data])) + 1
    return np.asarray(np.add.reduceat(on_samples(found, weights), np.concatenate([[0], begins]), axis=1))
