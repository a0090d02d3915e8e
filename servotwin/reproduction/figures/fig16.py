"""Fig 16: as Fig 15, sampled, with noise on the measured position; then with our estimator."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures import worn
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.loops import NOISY, OURS, PUBLISHED, LoopJob, Record
from servotwin.reproduction.runs import Runs


@dataclass(frozen=True, eq=False)
class Data:
    """The published twin's run, that of ours, and the pitch (m/rad) that ties a tolerance to a gap."""

    noisy: Record
    ours: Record
    pitch: float


def data(runs: Runs) -> Data:
    """The packaged scenario with this preset."""
    noisy, ours = (runs.get(LoopJob(runs.preset, NOISY, method=method)) for method in (PUBLISHED, OURS))
    return Data(noisy, ours, runs.servo.p)


def plot(d: Data) -> Figure:
    """Position, gap and estimates; the same with our estimator, and both errors."""
    figure, panels = worn.sheet(5)
    worn.position(panels[0], d.noisy.trace)
    worn.gaps(panels[1], d.noisy, d.pitch)
    worn.position(panels[2], d.ours.trace, "position $q_3$, with our estimator")
    worn.gaps(panels[3], d.ours, d.pitch)
    worn.errors(panels[4], d.noisy, d.ours)
    for panel in (panels[1], panels[3]):
        style.legend(panel)
    return figure


PLATE = Plate(
    "fig16",
    "Fig 16. With measurement noise.",
    "As Fig 15 with the sampled controller, noise of 0.22 mm (high-passed between 10 and 50 Hz) on the measured"
    " position, a 20 Hz low-pass in the loop and a zero-phase one in the twin: (a) the true position, (b) gap and"
    " estimates. Then with our estimator, which needs no low-pass: (c) position, (d) gap and estimates; where a window"
    " does not fit the model, its estimate is refused and the dead zone stays. (e) How far the estimates of both are"
    " off, and half the width of the 95 % intervals that they state.",
    data,
    plot,
)
