"""Fig 16: as Fig 15, sampled, with noise on the measured position."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.reproduce.figures import style, worn
from servotwin.reproduce.figures.plate import Plate
from servotwin.reproduce.loops import NOISY, LoopJob, Record
from servotwin.reproduce.runs import Runs


@dataclass(frozen=True, eq=False)
class Data:
    """The run, and the pitch (m/rad) that ties a tolerance to a gap."""

    noisy: Record
    pitch: float


def data(runs: Runs) -> Data:
    """The packaged scenario with this preset."""
    return Data(runs.get(LoopJob(runs.preset, NOISY)), runs.servo.p)


def plot(d: Data) -> Figure:
    """Position, then gap and estimates."""
    figure, (upper, lower) = worn.sheet(2)
    worn.position(upper, d.noisy.trace)
    worn.gaps(lower, d.noisy, d.pitch)
    style.legend(lower)
    return figure


PLATE = Plate(
    "fig16",
    "Fig 16. With measurement noise.",
    "As Fig 15 with the sampled controller, noise of 0.22 mm (high-passed between 10 and 50 Hz) on the measured"
    " position, a 20 Hz low-pass in the loop and a zero-phase one in the twin: (a) the true position, (b) gap and"
    " estimates.",
    data,
    plot,
)
