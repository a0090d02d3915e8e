"""Figs 4 and 5: frequency responses of the plant's linear parts; step and frequency response of the closed loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.measures import Array, Complex
from servotwin.reproduction.runs import AMPLITUDE, Runs

SPAN = 20.0  # s: half a period of the square wave


@dataclass(frozen=True, eq=False)
class PlantResponses:
    """Frequencies (rad/s), G1 (rad/V) and G2 (m/rad) there."""

    omega: Array
    G1: Complex
    G2: Complex


@dataclass(frozen=True, eq=False)
class ClosedLoopResponses:
    """Step response (m) over time (s), closed loop over frequency (rad/s), and the loop's gain crossovers (rad/s)."""

    time: Array
    position: Array
    omega: Array
    closed_loop: Complex
    crossovers: Array


def fig4_data(runs: Runs) -> PlantResponses:
    """Compute both responses from 0.1 to 1000 rad/s."""
    omega = np.geomspace(0.1, 1000.0, 1200)
    return PlantResponses(omega, runs.servo.G1().response(omega), runs.servo.G2().response(omega))


def _fig4_plot(d: PlantResponses) -> Figure:
    """Draw magnitude above phase, motor left, structure right."""
    figure, axes = style.panels(2, 2, height=2.0)
    for column, (response, color, name, unit) in enumerate(
        ((d.G1, style.BLUE, "Motor $G_1$", "rad/V"), (d.G2, style.RED, "Structure $G_2$", "m/rad"))
    ):
        style.bode(axes[0, column], axes[1, column], d.omega, response, color, f"Magnitude (dB re 1 {unit})")
        axes[0, column].set_title(name)
    style.label_panels(axes[0])
    return figure


def fig5_data(runs: Runs) -> ClosedLoopResponses:
    """Compute a 1 mm step and the closed loop's response from 0.1 to 100 rad/s."""
    time = np.linspace(0.0, SPAN, 4001)
    omega = np.geomspace(0.1, 100.0, 2000)
    closed = runs.servo.closed_loop()
    crossovers = np.array([one.omega for one in runs.servo.margins().gain_crossovers])
    return ClosedLoopResponses(time, AMPLITUDE * closed.step(time), omega, closed.response(omega), crossovers)


def _fig5_plot(d: ClosedLoopResponses) -> Figure:
    """Draw the step response above, magnitude and phase below."""
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
    style.label_panels((step, magnitude))
    return figure


FIGURES = (
    FigureSpec(
        "fig4",
        "Fig 4. The two linear parts of the plant.",
        "Frequency response (a) of the motor, from voltage to angle, and (b) of the structure, from the screw's angle"
        " to the position of the last mass.",
        fig4_data,
        _fig4_plot,
    ),
    FigureSpec(
        "fig5",
        "Fig 5. The linear closed loop.",
        "(a) Position of the last mass after a 1 mm step of the reference; (b) frequency response from reference to"
        " position.",
        fig5_data,
        _fig5_plot,
    ),
)
