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

__all__ = ["METHOD", "SHORTEST", "WhitenedSettings", "WindowFit", "estimate", "fit", "shortest_window"]
