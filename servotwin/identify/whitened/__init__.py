"""The default estimator: exact structure, nuisances projected out, noise whitened, every answer gated."""

from servotwin.identify.whitened.estimator import METHOD, SHORTEST, Settings, estimate

__all__ = ["METHOD", "SHORTEST", "Settings", "estimate"]
