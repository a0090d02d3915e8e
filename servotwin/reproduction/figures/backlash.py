"""Figs 7 and 9 to 12: the backlash, the limit cycles it causes, and the fixed dead zone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from servotwin.plant.backlash import play
from servotwin.report import style
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import AMPLITUDE, ESTIMATE_DEG, Runs, StepJob, Trace

PLAY_DEG, _PLAY_SPAN = 20.0, 5.0  # Fig 7: total gap, and seconds shown
GAPS_DEG, _GAPS_SPAN = (0.0, 5.0, 10.0, 15.0), 8.0  # Figs 9 and 11: total gaps, and seconds shown
_SWITCHING_SPAN = 4.0  # s, Fig 10(b)

TraceByGap = Mapping[float, Trace]  # by total gap, deg


@dataclass(frozen=True, eq=False)
class PlayMotion:
    """Time (s), motor and screw angle (rad)."""

    time: Array
    theta_m: Array
    theta_d: Array


def fig7_data(_runs: Runs | None = None) -> PlayMotion:
    """Compute theta_m = (1 + t/10) sin(2 pi t) in rad (erratum E21) through a total gap of 20 deg."""
    time = np.linspace(0.0, _PLAY_SPAN, 5001)
    theta_m = (1.0 + time / 10.0) * np.sin(2.0 * np.pi * time)
    return PlayMotion(time, theta_m, play(theta_m, math.radians(PLAY_DEG), 0.0))


def _fig7_plot(d: PlayMotion) -> Figure:
    """Draw the waveforms left, one against the other right."""
    figure = style.sheet(7.2, 3.0)
    waves, against = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
    waves.plot(d.time, d.theta_m * style.DEG, color=style.BLUE, label="motor $θ_m$")
    waves.plot(d.time, d.theta_d * style.DEG, color=style.RED, label="screw $θ_d$")
    waves.set(xlabel="Time (s)", ylabel="Angle (deg)", xlim=(0.0, _PLAY_SPAN))
    style.legend(waves)
    against.plot(d.theta_m * style.DEG, d.theta_d * style.DEG, color=style.BLACK, linewidth=1.0)
    against.set(xlabel="Motor angle $θ_m$ (deg)", ylabel="Screw angle $θ_d$ (deg)", aspect="equal")
    for axis in (waves.yaxis, against.xaxis, against.yaxis):
        axis.set_major_locator(MultipleLocator(30.0))
    style.label_panels((waves, against))
    return figure


def fig9_data(runs: Runs) -> TraceByGap:
    """Simulate 1 mm steps for total gaps of 0, 5, 10 and 15 deg without a dead zone."""
    return {gap: runs.step(gap, None) for gap in GAPS_DEG}


def fig11_data(runs: Runs) -> TraceByGap:
    """Simulate 1 mm steps for the same gaps, with the dead zone for 10 deg."""
    return {gap: runs.step(gap, ESTIMATE_DEG) for gap in GAPS_DEG}


def _plot_by_gap(d: TraceByGap) -> Figure:
    """Draw one row per gap: position left, angles right, all rows on equal scales."""
    figure = style.sheet(7.2, 1.45 * len(d) + 0.5)
    axes = figure.subplots(len(d), 2, sharex=True, sharey="col", squeeze=False)
    for row, (gap, trace) in zip(axes, d.items(), strict=True):
        _position(row[0], gap, trace)
        _angles(row[1], trace)
    style.legend(axes[0, 0])
    style.legend(axes[0, 1])
    style.label_panels(axes[0])
    for last in axes[-1]:
        last.set(xlabel="Time (s)", xlim=(0.0, _GAPS_SPAN))
    return figure


def _position(axes: Any, gap: float, trace: Trace) -> None:
    shown = trace.time <= _GAPS_SPAN
    axes.axhline(AMPLITUDE * style.MM, color=style.GREY, linewidth=1.0, linestyle="--", label="reference")
    if trace.tolerance[0] > 0.0:
        band = [(AMPLITUDE + sign * trace.tolerance[0]) * style.MM for sign in (-1.0, 1.0)]
        axes.axhspan(*band, color=style.YELLOW, alpha=0.5, linewidth=0.0, label="dead zone")
    style.trace(axes, trace.time[shown], trace.position[shown] * style.MM, style.BLUE, "position $q_3$")
    axes.set_ylabel("Position (mm)")
    axes.text(0.99, 0.94, f"gap {gap:g} deg", transform=axes.transAxes, ha="right", va="top", fontweight="bold")


def _angles(axes: Any, trace: Trace) -> None:
    shown = trace.time <= _GAPS_SPAN
    style.trace(axes, trace.time[shown], trace.theta_m[shown] * style.DEG, style.SKY, "motor $θ_m$", linewidth=2.6)
    style.trace(axes, trace.time[shown], trace.theta_d[shown] * style.DEG, style.RED, "screw $θ_d$", linewidth=1.0)
    axes.set_ylabel("Angle (deg)")


@dataclass(frozen=True, eq=False)
class DeadZoneSignals:
    """Time (s), error e and dead-zone error e_DZ (m), voltage (V), tolerance (m); times (s) of entry and exit."""

    time: Array
    error: Array
    dead_zone_error: Array
    voltage: Array
    tolerance: float
    enter: Array
    leave: Array

    @property
    def open_intervals(self) -> list[tuple[float, float]]:
        """Intervals (s) with the loop open: from each entry to the next exit, or to the end."""
        ends = [float(next(iter(self.leave[self.leave > begin]), self.time[-1])) for begin in self.enter]
        return list(zip(map(float, self.enter), ends, strict=True))


@dataclass(frozen=True, slots=True)
class DeadZoneJob:
    """The dead zone's signals in a step run."""

    step: StepJob

    def run(self) -> DeadZoneSignals:
        """Simulate; signals at `RATE` and the exact times of the switches."""
        run = self.step.simulate()
        error, tolerance = run.reference - run.position, float(run.tolerance[0])
        inside = np.abs(error) <= tolerance
        enter, leave = (run.events.time[run.events.kind == kind] for kind in ("enter", "leave"))
        return DeadZoneSignals(run.time, error, np.where(inside, 0.0, error), run.voltage, tolerance, enter, leave)


def fig10b_data(runs: Runs) -> DeadZoneSignals:
    """Simulate a 1 mm step with a gap of 10 deg and the dead zone for it, at the full rate."""
    return runs.get(DeadZoneJob(StepJob(runs.preset, ESTIMATE_DEG, ESTIMATE_DEG, duration=_SWITCHING_SPAN)))


def _fig10b_plot(d: DeadZoneSignals) -> Figure:
    """Draw error and dead-zone error above, voltage below; the dead zone shaded where it is active."""
    figure, axes = style.panels(2, 1, height=1.9)
    upper, lower = axes[:, 0]
    tolerance, fed = d.tolerance * style.MM, d.dead_zone_error * style.MM
    upper.axhspan(-tolerance, tolerance, color=style.YELLOW, alpha=0.5, linewidth=0.0, label="tolerance $±ε_{DZ}$")
    upper.plot(d.time, d.error * style.MM, color=style.BLUE, label="error $e$")
    upper.plot(d.time, fed, color=style.RED, linewidth=1.0, linestyle="--", label="dead-zone error $e_{DZ}$")
    upper.set_ylabel("Error (mm)")
    style.legend(upper)
    lower.plot(d.time, d.voltage, color=style.BLACK, linewidth=1.0, label="voltage $u$")
    lower.set(ylabel="Voltage (V)", xlabel="Time (s)", xlim=(0.0, _SWITCHING_SPAN))
    for begin, end in d.open_intervals:
        lower.axvspan(begin, end, color=style.YELLOW, alpha=0.5, linewidth=0.0)
    style.legend(lower)
    return figure


@dataclass(frozen=True, eq=False)
class FixedDeadZoneRun:
    """The run, and the pitch (m/rad) that ties its tolerance to a gap."""

    run: Trace
    pitch: float


def fig12_data(runs: Runs) -> FixedDeadZoneRun:
    """Simulate a square wave of +-1 mm, gap 0 -> 20 deg along an S-curve, dead zone for 10 deg."""
    return FixedDeadZoneRun(runs.wear(), runs.servo.p)


def _fig12_plot(d: FixedDeadZoneRun) -> Figure:
    """Draw the position above, gap and fixed estimate below."""
    figure, (upper, lower) = wear_panels.sheet(2)
    wear_panels.position(upper, d.run)
    wear_panels.true_gap(lower, d.run)
    wear_panels.gap_in_force(lower, d.run, d.pitch, "estimate, fixed")
    style.legend(lower)
    return figure


FIGURES = (
    FigureSpec(
        "fig7",
        "Fig 7. The backlash.",
        "Motor and screw angle for the input of Eq 19 and a total gap of 20 deg: (a) over time, (b) one against the"
        " other.",
        fig7_data,
        _fig7_plot,
    ),
    FigureSpec(
        "fig9",
        "Fig 9. The gap makes the loop oscillate.",
        "(a) Position of the last mass after a 1 mm step and (b) the angles of motor and screw, for four total gaps"
        " and without a dead zone.",
        fig9_data,
        _plot_by_gap,
    ),
    FigureSpec(
        "fig10b",
        "Fig 10(b). The dead-zone controller at work.",
        "A 1 mm step with a gap of 10 deg and the dead zone for it: above, the error and the dead-zone error, which is"
        " the controller's input; below, the voltage, which is zero while the error is inside the tolerance (shaded).",
        fig10b_data,
        _fig10b_plot,
    ),
    FigureSpec(
        "fig11",
        "Fig 11. The dead zone makes the loop settle.",
        "As Fig 9, with a dead zone for a gap of 10 deg in all four runs.",
        fig11_data,
        _plot_by_gap,
    ),
    FigureSpec(
        "fig12",
        "Fig 12. The gap outgrows a fixed dead zone.",
        f"(a) Position under a square wave while the gap wears, with a dead zone for {ESTIMATE_DEG:g} deg;"
        " (b) the gap and the fixed estimate.",
        fig12_data,
        _fig12_plot,
    ),
)
