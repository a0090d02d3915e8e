"""A figure: its texts, its data and its drawing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.policy_runs import PolicyOutcome
from servotwin.reproduction.runs import Runs

_Data = TypeVar("_Data")


@dataclass(frozen=True)
class FigureSpec(Generic[_Data]):
    """One figure, of the paper or beyond it.

    Attributes
    ----------
    name : str
        Name of its files, such as "fig7".
    title, caption : str
    data : callable
        Runs -> arrays, SI units; no drawing.
    plot : callable
        Arrays -> Figure; no computing.
    outcomes : callable, optional
        Arrays -> outcome of each policy, for the tables of figures that compare policies.
    """

    name: str
    title: str
    caption: str
    data: Callable[[Runs], _Data]
    plot: Callable[[_Data], Figure]
    outcomes: Callable[[_Data], Sequence[PolicyOutcome]] | None = None

    def draw(self, runs: Runs) -> Figure:
        """Draw the figure for a preset."""
        with style.look():
            return self.plot(self.data(runs))

    def measure(self, runs: Runs) -> tuple[PolicyOutcome, ...]:
        """Compute the rows of the figure's tables for a preset; empty where it has none."""
        return () if self.outcomes is None else tuple(self.outcomes(self.data(runs)))


@dataclass(frozen=True)
class DrawnFigure:
    """A figure as drawn: name, title, caption, vector image, and outcomes of the policies without their runs."""

    name: str
    title: str
    caption: str
    vector: bytes
    outcomes: tuple[PolicyOutcome, ...] = ()
