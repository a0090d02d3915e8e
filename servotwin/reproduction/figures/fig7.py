"""Fig 7: input and output of the backlash for the input of Eq 19."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from servotwin.plant.backlash import play
from servotwin.report import style
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import Runs

GAP_DEG, SPAN = 20.0, 5.0


@dataclass(frozen=True, eq=False)
class Data:
    """Time (s), motor and screw angle (rad)."""

    time: Array
    theta_m: Array
    theta_d: Array


def data(_runs: Runs | None = None) -> Data:
    """theta_m = (1 + t/10) sin(2 pi t) in rad (erratum E21) through a total gap of 20 deg."""
    time = np.linspace(0.0, SPAN, 5001)
    theta_m = (1.0 + time / 10.0) * np.sin(2.0 * np.pi * time)
    return Data(time, theta_m, play(theta_m, math.radians(GAP_DEG), 0.0))


def plot(d: Data) -> Figure:
    """Waveforms left, one against the other right."""
    figure = style.sheet(7.2, 3.0)
    waves, against = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
    waves.plot(d.time, d.theta_m * style.DEG, color=style.BLUE, label="motor $θ_m$")
    waves.plot(d.time, d.theta_d * style.DEG, color=style.RED, label="screw $θ_d$")
    waves.set(xlabel="Time (s)", ylabel="Angle (deg)", xlim=(0.0, SPAN))
    style.legend(waves)
    against.plot(d.theta_m * style.DEG, d.theta_d * style.DEG, color=style.BLACK, linewidth=1.0)
    against.set(xlabel="Motor angle $θ_m$ (deg)", ylabel="Screw angle $θ_d$ (deg)", aspect="equal")
    for axis in (waves.yaxis, against.xaxis, against.yaxis):
        axis.set_major_locator(MultipleLocator(30.0))
    style.letter((waves, against))
    return figure


PLATE = Plate(
    "fig7",
    "Fig 7. The backlash.",
    "Motor and screw angle for the input of Eq 19 and a total gap of 20 deg: (a) over time, (b) one against the other.",
    data,
    plot,
)
