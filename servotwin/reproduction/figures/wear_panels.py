"""Panels shared by Figs 12, 15 and 16 and the demo: position under a wearing gap, gap and estimates, errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from servotwin.plant.display_units import MILLIMETRES, DisplayUnit
from servotwin.report import style
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import DURATION, Trace
from servotwin.reproduction.twin_runs import EstimateRecord, TwinRun

FAINTEST = 1e-4  # deg; smaller errors are drawn at this value


def sheet(rows: int, duration: float = DURATION) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels over so many s; the last one is labelled for the gap."""
    figure, axes = style.panels(rows, 1, height=1.9)
    panels = list(axes[:, 0])
    panels[-1].set(xlabel="Time (s)", xlim=(0.0, duration), ylabel="Total gap (deg)")
    panels[-1].xaxis.set_major_locator(MaxNLocator(10))
    style.label_panels(panels)
    figure.align_ylabels(panels)
    return figure, panels


def position(axes: Axes, trace: Trace, what: str = "position $q_3$", unit: DisplayUnit = MILLIMETRES) -> None:
    """Draw reference and position; shade the steps that did not settle."""
    for step in trace.steps:
        if not step.settled:
            axes.axvspan(step.begin, step.end, color=style.ORANGE, alpha=0.22, linewidth=0.0)
    style.trace(axes, trace.time, trace.position * unit.factor, style.BLUE, what, linewidth=0.9)
    reference = corners(trace.time[:-1], trace.reference[:-1] * unit.factor)
    axes.plot(*reference, color=style.BLACK, linewidth=1.0, label="reference $r$")
    if not all(step.settled for step in trace.steps):
        axes.fill_between([], [], color=style.ORANGE, alpha=0.22, linewidth=0.0, label="not settled")
    axes.set_ylabel(f"Position ({unit.name})")
    style.legend(axes)


def corners(time: Array, values: Array) -> tuple[Array, Array]:
    """Reduce a piecewise constant signal to its corners: times and values."""
    jumps = np.flatnonzero(np.diff(values))
    keep = np.unique(np.concatenate([[0], jumps, jumps + 1, [len(values) - 1]]))
    times = time[keep].copy()
    times[np.isin(keep, jumps)] = time[jumps + 1]
    return times, values[keep]


def true_gap(axes: Axes, trace: Trace) -> None:
    """Draw the true gap."""
    style.trace(axes, trace.time, trace.gap * style.DEG, style.BLACK, "actual gap $θ_b$")


def gaps(axes: Axes, run: TwinRun, pitch: float) -> None:
    """Draw the gap, the twin's estimates with their spread, and the gap for which the dead zone in force is made."""
    true_gap(axes, run.trace)
    gap_in_force(axes, run.trace, pitch, "dead zone in force")
    estimates(axes, run.estimates)


def estimates(axes: Axes, given: Sequence[EstimateRecord]) -> None:
    """Draw the twin's estimates with their spread; refused ones as crosses at the prior, where there is one."""
    accepted = _columns((e.time, e.gap * style.DEG, e.std * style.DEG) for e in given if e.ok)
    if accepted:
        time, value, spread = accepted
        axes.errorbar(time, value, spread, fmt="o", color=style.BLUE, markersize=4.0, capsize=2.0, label="estimates")
    refused = _columns((e.time, e.gap * style.DEG) for e in given if not e.ok and np.isfinite(e.gap))
    if refused:
        axes.plot(*refused, "x", color=style.GREY, markersize=6.0, label="refused, prior")
    axes.set_ylabel("Total gap (deg)")


def errors(axes: Axes, published: TwinRun, ours: TwinRun) -> None:
    """Draw errors and 95 % intervals of both twins' estimates on one logarithmic axis."""
    later = 2.0  # s, so that neither hides the other
    for run, name, color, marker, late in (
        (published, "published", style.ORANGE, "s", 0.0),
        (ours, "ours", style.BLUE, "o", later),
    ):
        rows = ((e.time + late, abs(e.error) * style.DEG, _half(e) * style.DEG) for e in run.estimates if e.ok)
        time, error, half = _columns(rows)
        axes.vlines(time, np.maximum(error, FAINTEST), half, color=color, linewidth=0.8)
        axes.plot(time, half, "_", color=color, markersize=9.0, label=f"{name}: 95 % interval")
        axes.plot(time, np.maximum(error, FAINTEST), marker, color=color, markersize=4.5, label=f"{name}: error")
    axes.set(yscale="log", ylabel="Error (deg)", ylim=(0.5 * FAINTEST, 6.0), xlim=(-1.0, DURATION))
    style.legend(axes)


def _half(estimate: EstimateRecord) -> float:
    """Half the width of the 95 % interval, rad."""
    return 0.5 * (estimate.interval[1] - estimate.interval[0])


def _columns(rows: Iterable[tuple[float, ...]]) -> list[Array]:
    """Transpose rows into (n,) arrays; empty without rows."""
    return [np.array(column) for column in zip(*rows, strict=True)]


def gap_in_force(axes: Axes, trace: Trace, pitch: float, label: str) -> None:
    """Draw the gap for which the dead zone in force is made: tolerance over pitch (Eq 21 with k_DZ = 1)."""
    axes.plot(*corners(trace.time, trace.tolerance / pitch * style.DEG), color=style.RED, label=label)
