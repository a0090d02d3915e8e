"""The estimator as published (section 4.1, Eqs 22-23, Appendix)."""

from servotwin.estimation.paper.estimator import METHOD, PaperSettings, estimate, shortest_window

__all__ = ["METHOD", "PaperSettings", "estimate", "shortest_window"]
