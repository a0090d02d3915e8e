"""Fig 15: the twin follows the wearing gap; continuous, as in the paper, and sampled, as deployed; then with ours."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures import worn
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.loops import CONTINUOUS, OURS, SAMPLED, LoopJob, Record
from servotwin.reproduction.runs import Runs


@dataclass(frozen=True, eq=False)
class Data:
    """The published twin's runs, that of ours, and the pitch (m/rad) that ties a tolerance to a gap."""

    continuous: Record
    sampled: Record
    ours: Record
    pitch: float


def data(runs: Runs) -> Data:
    """The packaged scenarios with this preset."""
    continuous, sampled = (runs.get(LoopJob(runs.preset, name)) for name in (CONTINUOUS, SAMPLED))
    return Data(continuous, sampled, runs.get(LoopJob(runs.preset, CONTINUOUS, method=OURS)), runs.servo.p)


def plot(d: Data) -> Figure:
    """Position continuous, position sampled, gap and estimates; the same with our estimator, and both errors."""
    figure, panels = worn.sheet(6)
    worn.position(panels[0], d.continuous.trace, "position $q_3$, continuous controller")
    worn.position(panels[1], d.sampled.trace, "position $q_3$, controller sampled at 5 kHz")
    worn.gaps(panels[2], d.continuous, d.pitch)
    worn.position(panels[3], d.ours.trace, "position $q_3$, with our estimator")
    worn.gaps(panels[4], d.ours, d.pitch)
    worn.errors(panels[5], d.continuous, d.ours)
    for panel in (panels[2], panels[4]):
        style.legend(panel)
    return figure


PLATE = Plate(
    "fig15",
    "Fig 15. The twin keeps the dead zone up to date.",
    "Position while the gap wears and the twin's estimates set the dead zone 3 s after each step: (a) with the paper's"
    " continuous controller, (b) with the sampled one; (c) the gap, the twin's estimates (at the middle of their"
    " windows) and the gap that the dead zone in force is made for, from run (a). Then run (a) again with our"
    " estimator, for which the motor's angle is sent with 32 bits instead of 16: (d) position, (e) gap and estimates."
    " (f) How far the estimates of both are off, and half the width of the 95 % intervals that they state; errors below"
    f" {worn.FAINTEST:g} deg are drawn there.",
    data,
    plot,
)
