"""Fig 4: frequency response of the two linear parts of the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.measures import Array, Complex
from servotwin.reproduction.runs import Runs


@dataclass(frozen=True, eq=False)
class Data:
    """Frequencies (rad/s), G1 (rad/V) and G2 (m/rad) there."""

    omega: Array
    G1: Complex
    G2: Complex


def data(runs: Runs) -> Data:
    """Both responses from 0.1 to 1000 rad/s."""
    omega = np.geomspace(0.1, 1000.0, 1200)
    return Data(omega, runs.servo.G1().response(omega), runs.servo.G2().response(omega))


def plot(d: Data) -> Figure:
    """Magnitude above phase, motor left, structure right."""
    figure, axes = style.panels(2, 2, height=2.0)
    for column, (response, color, name, unit) in enumerate(
        ((d.G1, style.BLUE, "Motor $G_1$", "rad/V"), (d.G2, style.RED, "Structure $G_2$", "m/rad"))
    ):
        style.bode(axes[0, column], axes[1, column], d.omega, response, color, f"Magnitude (dB re 1 {unit})")
        axes[0, column].set_title(name)
    style.letter(axes[0])
    return figure


PLATE = Plate(
    "fig4",
    "Fig 4. The two linear parts of the plant.",
    "Frequency response (a) of the motor, from voltage to angle, and (b) of the structure, from the screw's angle to"
    " the position of the last mass.",
    data,
    plot,
)
