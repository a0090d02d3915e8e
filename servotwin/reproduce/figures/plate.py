"""A figure as a pair of functions: what is in it, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from matplotlib.figure import Figure

from servotwin.reproduce.figures import style
from servotwin.reproduce.runs import Runs

_Data = TypeVar("_Data")


@dataclass(frozen=True)
class Plate(Generic[_Data]):
    """One figure of the paper.

    Attributes
    ----------
    name : str
        Of its files, such as "fig7".
    title, caption : str
    data : callable
        Runs -> arrays, SI units; no drawing.
    plot : callable
        Arrays -> Figure; no computing.
    """

    name: str
    title: str
    caption: str
    data: Callable[[Runs], _Data]
    plot: Callable[[_Data], Figure]

    def draw(self, runs: Runs) -> Figure:
        """The figure for a preset."""
        with style.look():
            return self.plot(self.data(runs))
