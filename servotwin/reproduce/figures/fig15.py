"""Fig 15: the twin follows the wearing gap; continuous, as in the paper, and sampled, as deployed."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.reproduce.figures import style, worn
from servotwin.reproduce.figures.plate import Plate
from servotwin.reproduce.loops import CONTINUOUS, SAMPLED, LoopJob, Record
from servotwin.reproduce.runs import Runs


@dataclass(frozen=True, eq=False)
class Data:
    """Both runs, and the pitch (m/rad) that ties a tolerance to a gap."""

    continuous: Record
    sampled: Record
    pitch: float


def data(runs: Runs) -> Data:
    """The packaged scenarios with this preset."""
    continuous, sampled = (runs.get(LoopJob(runs.preset, name)) for name in (CONTINUOUS, SAMPLED))
    return Data(continuous, sampled, runs.servo.p)


def plot(d: Data) -> Figure:
    """Position continuous, position sampled, gap and estimates."""
    figure, (upper, middle, lower) = worn.sheet(3)
    worn.position(upper, d.continuous.trace, "position $q_3$, continuous controller")
    worn.position(middle, d.sampled.trace, "position $q_3$, controller sampled at 5 kHz")
    worn.gaps(lower, d.continuous, d.pitch)
    style.legend(lower)
    return figure


PLATE = Plate(
    "fig15",
    "Fig 15. The twin keeps the dead zone up to date.",
    "Position while the gap wears and the twin's estimates set the dead zone 3 s after each step: (a) with the paper's"
    " continuous controller, (b) with the sampled one; (c) the gap, the twin's estimates (at the middle of their"
    " windows) and the gap that the dead zone in force is made for, from run (a).",
    data,
    plot,
)
