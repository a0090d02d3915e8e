"""Figures of the paper in its order (`PAPER`), then those beyond it (`BEYOND`)."""

from typing import Any

from servotwin.reproduction.figures import backlash, estimator, linear, observer, policies, twin
from servotwin.reproduction.figures.spec import DrawnFigure, FigureSpec

PAPER: tuple[FigureSpec[Any], ...] = (*linear.FIGURES, *backlash.FIGURES, *twin.FIGURES, observer.FIGURE)
BEYOND: tuple[FigureSpec[Any], ...] = (estimator.FIGURE, *policies.FIGURES)
FIGURES = (*PAPER, *BEYOND)

__all__ = ["BEYOND", "FIGURES", "PAPER", "DrawnFigure", "FigureSpec"]
