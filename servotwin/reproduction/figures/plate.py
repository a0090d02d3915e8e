"""A figure as a pair of functions: what is in it, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.beyond import Outcome
from servotwin.reproduction.runs import Runs

_Data = TypeVar("_Data")


@dataclass(frozen=True)
class Plate(Generic[_Data]):
    """One figure, of the paper or beyond it.

    Attributes
    ----------
    name : str
        Of its files, such as "fig7".
    title, caption : str
    data : callable
        Runs -> arrays, SI units; no drawing.
    plot : callable
        Arrays -> Figure; no computing.
    outcomes : callable, optional
        Of figures beyond the paper that compare policies: arrays -> what came of each, for tables.
    """

    name: str
    title: str
    caption: str
    data: Callable[[Runs], _Data]
    plot: Callable[[_Data], Figure]
    outcomes: Callable[[_Data], Sequence[Outcome]] | None = None

    def draw(self, runs: Runs) -> Figure:
        """The figure for a preset."""
        with style.look():
            return self.plot(self.data(runs))

    def measure(self, runs: Runs) -> tuple[Outcome, ...]:
        """What is to be tabled for a preset."""
        return () if self.outcomes is None else tuple(self.outcomes(self.data(runs)))
