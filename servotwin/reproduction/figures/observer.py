"""Fig A.1: three observers that start without knowing the structure's state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from servotwin.estimation.paper.observer import observer
from servotwin.plant.backlash import play
from servotwin.report import style
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import RATE, Runs

_GAP_DEG = 30.0
INITIAL = np.array([-1.5, 5.0, 0.1, 0.0]) * 1e-3  # y and its first three derivatives: m, m/s, m/s^2, m/s^3
ALPHAS = (20.0, 40.0, 80.0)
SPAN = 1.0


@dataclass(frozen=True, eq=False)
class ObserverOutputs:
    """Time (s), motor and screw angle (rad), the output (m) and its estimates by alpha (rad/s)."""

    time: Array
    theta_m: Array
    theta_d: Array
    position: Array
    estimates: Mapping[float, Array]


def figA1_data(runs: Runs) -> ObserverOutputs:
    """Simulate Eq 19 through a gap of 30 deg into G2 from the paper's initial state; the observers start at zero."""
    time = np.arange(round(SPAN * RATE) + 1) / RATE
    theta_m = (1.0 + time / 10.0) * np.sin(2.0 * np.pi * time)
    theta_d = play(theta_m, math.radians(_GAP_DEG), 0.0)
    observers = {alpha: observer(runs.servo, alpha) for alpha in ALPHAS}
    plant = observers[ALPHAS[0]]
    system = (plant.A_o, plant.B[:, None], plant.C[None, :], 0.0)
    _, position, _ = signal.lsim(system, theta_d, time, plant.initial_state(INITIAL))
    estimates = {alpha: one.estimate(theta_d, position, RATE) for alpha, one in observers.items()}
    return ObserverOutputs(time, theta_m, theta_d, position, estimates)


def _plot(d: ObserverOutputs) -> Figure:
    """Draw angles above, outputs below."""
    figure, axes = style.panels(2, 1, height=2.1, heights=(1.0, 1.4))
    upper, lower = axes[:, 0]
    upper.plot(d.time, d.theta_m * style.DEG, color=style.ORANGE, label="motor $θ_m$")
    upper.plot(d.time, d.theta_d * style.DEG, color=style.RED, label="screw $θ_d$")
    upper.set_ylabel("Angle (deg)")
    lower.plot(d.time, d.position * style.MM, color=style.BLACK, linewidth=1.8, label="position $q_3$")
    for (alpha, estimate), color in zip(d.estimates.items(), (style.SKY, style.BLUE, style.PINK), strict=True):
        lower.plot(d.time, estimate * style.MM, color=color, linestyle="--", label=f"observer, α = {alpha:g} 1/s")
    lower.axvline(0.25, color=style.GREY, linewidth=1.0, linestyle=":")
    lower.set(ylabel="Position (mm)", xlabel="Time (s)", xlim=(0.0, SPAN))
    style.legend(upper)
    style.legend(lower)
    style.label_panels((upper, lower))
    return figure


FIGURE = FigureSpec(
    "figA1",
    "Fig A.1. Observers that start from a wrong state.",
    "(a) Our input, Eq 19, and the screw behind a gap of 30 deg; (b) the structure's output from the paper's initial"
    " state and three observers that start from zero. The dotted line marks 0.25 s.",
    figA1_data,
    _plot,
)
