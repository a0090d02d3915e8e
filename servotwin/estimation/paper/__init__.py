"""The estimator as published (section 4.1, Eqs 22-23, Appendix)."""

from servotwin.estimation.paper.estimator import METHOD, Settings, estimate

__all__ = ["METHOD", "Settings", "estimate"]
