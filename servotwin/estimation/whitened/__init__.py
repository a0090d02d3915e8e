"""The default estimator: exact structure, nuisances projected out, noise whitened, every answer gated."""

from servotwin.estimation.whitened.estimator import (
    METHOD,
    SHORTEST,
    WhitenedSettings,
    WindowFit,
    estimate,
    fit,
    shortest_window,
)
from servotwin.estimation.whitened.offset import estimate_carrying, read_offset

__all__ = [
    "METHOD",
    "SHORTEST",
    "WhitenedSettings",
    "WindowFit",
    "estimate",
    "estimate_carrying",
    "fit",
    "read_offset",
    "shortest_window",
]
