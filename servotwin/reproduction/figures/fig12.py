"""Fig 12: the wearing gap outgrows a fixed dead zone."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures import worn
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.runs import ESTIMATE_DEG, Runs, Trace


@dataclass(frozen=True, eq=False)
class Data:
    """The run, and the pitch (m/rad) that ties its tolerance to a gap."""

    run: Trace
    pitch: float


def data(runs: Runs) -> Data:
    """Square wave of +-1 mm, gap 0 -> 20 deg along an S-curve, dead zone for 10 deg."""
    return Data(runs.wear(), runs.servo.p)


def plot(d: Data) -> Figure:
    """Position above, gap and fixed estimate below."""
    figure, (upper, lower) = worn.sheet(2)
    worn.position(upper, d.run)
    worn.true_gap(lower, d.run)
    worn.gap_in_force(lower, d.run, d.pitch, "estimate, fixed")
    style.legend(lower)
    return figure


PLATE = Plate(
    "fig12",
    "Fig 12. A fixed dead zone is outgrown.",
    f"(a) Position under a square wave while the gap wears, with a dead zone made for {ESTIMATE_DEG:g} deg;"
    " (b) the gap and the fixed estimate.",
    data,
    plot,
)
