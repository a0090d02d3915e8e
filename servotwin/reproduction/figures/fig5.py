"""Fig 5: step and frequency response of the linear closed loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.measures import Array, Complex
from servotwin.reproduction.runs import AMPLITUDE, Runs

SPAN = 20.0  # s: half a period of the square wave


@dataclass(frozen=True, eq=False)
class Data:
    """Step response (m) over time (s), closed loop over frequency (rad/s), and the loop's gain crossovers (rad/s)."""

    time: Array
    position: Array
    omega: Array
    closed_loop: Complex
    crossovers: Array


def data(runs: Runs) -> Data:
    """A 1 mm step and the response from 0.1 to 100 rad/s."""
    time = np.linspace(0.0, SPAN, 4001)
    omega = np.geomspace(0.1, 100.0, 2000)
    closed = runs.servo.closed_loop()
    crossovers = np.array([one.omega for one in runs.servo.margins().gain_crossovers])
    return Data(time, AMPLITUDE * closed.step(time), omega, closed.response(omega), crossovers)


def plot(d: Data) -> Figure:
    """Step response above, magnitude and phase below."""
    figure = style.sheet(7.2, 6.4)
    grid = figure.add_gridspec(3, 1, height_ratios=(1.3, 1.0, 0.8))
    step = figure.add_subplot(grid[0])
    step.axhline(AMPLITUDE * style.MM, color=style.GREY, linewidth=1.0, linestyle="--", label="reference")
    style.trace(step, d.time, d.position * style.MM, style.BLUE, "position $q_3$")
    step.set(xlabel="Time (s)", ylabel="Position (mm)", xlim=(0.0, SPAN))
    style.legend(step)
    magnitude = figure.add_subplot(grid[1])
    phase = figure.add_subplot(grid[2], sharex=magnitude)
    style.bode(magnitude, phase, d.omega, d.closed_loop, style.BLUE, "Magnitude (dB)")
    magnitude.tick_params(labelbottom=False)
    for omega in d.crossovers:
        magnitude.axvline(omega, color=style.ORANGE, linewidth=1.0, linestyle=":")
    magnitude.plot([], [], color=style.ORANGE, linestyle=":", label="gain crossovers of the loop")
    style.legend(magnitude)
    style.letter((step, magnitude))
    return figure


PLATE = Plate(
    "fig5",
    "Fig 5. The linear closed loop.",
    "(a) Position of the last mass after a 1 mm step of the reference; (b) frequency response from reference to"
    " position.",
    data,
    plot,
)
