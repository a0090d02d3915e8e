"""The layout that Figs 9 and 11 share: one row per gap, position left, angles of motor and screw right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.runs import AMPLITUDE, Runs, Trace

GAPS_DEG = (0.0, 5.0, 10.0, 15.0)
SPAN = 8.0  # s shown

Data = Mapping[float, Trace]  # by total gap, deg


def data(runs: Runs, dead_zone_deg: float | None) -> Data:
    """A 1 mm step for each gap."""
    return {gap: runs.step(gap, dead_zone_deg) for gap in GAPS_DEG}


def plot(d: Data) -> Figure:
    """Rows of equal scale, so that amplitudes can be compared."""
    figure = style.sheet(7.2, 1.45 * len(d) + 0.5)
    axes = figure.subplots(len(d), 2, sharex=True, sharey="col", squeeze=False)
    for row, (gap, trace) in zip(axes, d.items(), strict=True):
        _position(row[0], gap, trace)
        _angles(row[1], trace)
    style.legend(axes[0, 0])
    style.legend(axes[0, 1])
    style.letter(axes[0])
    for last in axes[-1]:
        last.set(xlabel="Time (s)", xlim=(0.0, SPAN))
    return figure


def _position(axes: Any, gap: float, trace: Trace) -> None:
    shown = trace.time <= SPAN
    axes.axhline(AMPLITUDE * style.MM, color=style.GREY, linewidth=1.0, linestyle="--", label="reference")
    if trace.tolerance[0] > 0.0:
        band = [(AMPLITUDE + sign * trace.tolerance[0]) * style.MM for sign in (-1.0, 1.0)]
        axes.axhspan(*band, color=style.YELLOW, alpha=0.5, linewidth=0.0, label="dead zone")
    style.trace(axes, trace.time[shown], trace.position[shown] * style.MM, style.BLUE, "position $q_3$")
    axes.set_ylabel("Position (mm)")
    axes.text(0.99, 0.94, f"gap {gap:g} deg", transform=axes.transAxes, ha="right", va="top", fontweight="bold")


def _angles(axes: Any, trace: Trace) -> None:
    shown = trace.time <= SPAN
    style.trace(axes, trace.time[shown], trace.theta_m[shown] * style.DEG, style.SKY, "motor $θ_m$", linewidth=2.6)
    style.trace(axes, trace.time[shown], trace.theta_d[shown] * style.DEG, style.RED, "screw $θ_d$", linewidth=1.0)
    axes.set_ylabel("Angle (deg)")
