"""Figures beyond the paper: the policies on the same wear, each in the same loop; errors left and updates sent."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from servotwin.messages import Gains
from servotwin.report import style
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.measures import Array
from servotwin.reproduction.policy_runs import (
    ALONE,
    BIASED,
    CLEAN,
    CONTESTANTS,
    NOISE,
    LoopCondition,
    PolicyJob,
    PolicyOutcome,
    worst,
)
from servotwin.reproduction.runs import AMPLITUDE, DURATION, Runs
from servotwin.reproduction.twin_runs import SettingChange, TwinRun


class _LineStyle(NamedTuple):
    """Colour, line width and marker; widths differ so that equal lines show through."""

    color: str
    width: float
    marker: str


_LINE_STYLES = {
    "paper": _LineStyle(style.ORANGE, 3.4, "s"),
    "margin": _LineStyle(style.GREEN, 2.6, "^"),
    "hysteresis": _LineStyle(style.PINK, 1.8, "D"),
    "certified": _LineStyle(style.BLUE, 1.0, "o"),
    ALONE: _LineStyle(style.SKY, 4.2, "v"),
}
APART = 1.5  # s, between markers that would hide one another
LEAST = 2e-5  # m: the errors' axis never shows less

RunsByPolicy = list[tuple[str, TwinRun]]


@dataclass(frozen=True, eq=False)
class PolicyComparison:
    """Outcome of each policy, the servo's own gains, and time (s), reference (m) and gap (rad) of all of them."""

    outcomes: tuple[PolicyOutcome, ...]
    own: Gains
    time: Array
    reference: Array
    gap: Array


def data_of(condition: LoopCondition, duration: float = DURATION) -> Callable[[Runs], PolicyComparison]:
    """Make the function that simulates every policy in a condition."""

    def data(runs: Runs) -> PolicyComparison:
        outcomes = tuple(runs.get(PolicyJob(runs.preset, policy, condition, duration)) for policy in CONTESTANTS)
        trace = next(one.run.trace for one in outcomes if one.run is not None)
        law = runs.servo.controller
        own = Gains(law.Kp, law.Ki, law.Kd, law.Tf)
        return PolicyComparison(outcomes, own, trace.time, trace.reference, trace.gap)

    return data


def plot(d: PolicyComparison) -> Figure:
    """Draw reference, one error per policy, gap and estimates, and in force: dead zone, gains, feedforward."""
    heights = (0.6, *(0.8 for _ in d.outcomes), 1.3, 1.0, 1.0, 1.0)
    figure, grid = style.panels(len(heights), 1, height=1.2, heights=heights)
    panels = list(grid[:, 0])
    reference, errors, (gap, tolerance, gains, feedforward) = panels[0], panels[1:-4], panels[-4:]
    _reference(reference, d)
    reach = _reach(d.outcomes)
    for axes, outcome in zip(errors, d.outcomes, strict=True):
        _error(axes, outcome, reach)
    ran = [(one.policy, one.run) for one in d.outcomes if one.run is not None]
    _gap(gap, ran, d)
    _in_force(tolerance, ran, lambda change: change.tolerance * style.MM, "Dead zone\n(mm)")
    style.legend(tolerance, columns=5)
    _gains(gains, ran, d.own)
    _in_force(feedforward, ran, lambda change: change.gains.feedforward * 1e3, "Feedforward\n(mV)")
    _widen(feedforward, 10.0)
    panels[-1].set(xlabel="Time (s)", xlim=(0.0, float(d.time[-1])))
    panels[-1].xaxis.set_major_locator(MultipleLocator(20.0))
    style.label_panels(panels)
    figure.align_ylabels(panels)
    return figure


def _reference(axes: Axes, d: PolicyComparison) -> None:
    axes.plot(*wear_panels.corners(d.time[:-1], d.reference[:-1] * style.MM), color=style.BLACK)
    axes.set(ylabel="Reference\n(mm)", ylim=(-1.4 * AMPLITUDE * style.MM, 1.4 * AMPLITUDE * style.MM))


def _reach(outcomes: Sequence[PolicyOutcome]) -> float:
    """Half the range of the errors' axis, m: the largest error left by any policy, with some room."""
    left = [step.error for one in outcomes for step in one.steps]
    return 1.3 * max([LEAST, *left])


def _error(axes: Axes, outcome: PolicyOutcome, reach: float) -> None:
    """Draw reference minus position; shade the steps that did not settle."""
    axes.set(ylabel="Error\n(mm)", ylim=(-reach * style.MM, reach * style.MM))
    axes.set_title(_title(outcome), loc="right", fontsize=8.0)
    if outcome.run is None:
        axes.grid(False)
        text = "\n".join(textwrap.wrap(outcome.refused, 110))
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=7.5, color=style.BLACK)
        return
    trace = outcome.run.trace
    for step in trace.steps:
        if not step.settled:
            axes.axvspan(step.begin, step.end, color=style.GREY, alpha=0.22, linewidth=0.0)
    error = (trace.reference - trace.position)[:-1] * style.MM
    style.trace(axes, trace.time[:-1], error, _LINE_STYLES[outcome.policy].color, linewidth=0.9)


def _title(outcome: PolicyOutcome) -> str:
    """Word the policy's outcome in one line."""
    if outcome.run is None:
        return f"{outcome.policy}: designs nothing here"
    settled, left = sum(step.settled for step in outcome.steps), worst(outcome.steps, "error") * style.MM
    return f"{outcome.policy}: {settled} of {len(outcome.steps)} steps settle, largest error left {left:.2g} mm"


def _gap(axes: Axes, ran: RunsByPolicy, d: PolicyComparison) -> None:
    """Draw the true gap and every policy's estimates; equal times are moved apart."""
    style.trace(axes, d.time, d.gap * style.DEG, style.BLACK, "actual gap")
    answered = [(policy, run) for policy, run in ran if run.estimates]
    for later, (policy, run) in enumerate(answered):
        known = [one for one in run.estimates if one.ok]
        times = [one.time + APART * later for one in known]
        values, half = ([getattr(one, name) * style.DEG for one in known] for name in ("gap", "std"))
        look = _LINE_STYLES[policy]
        spread = np.multiply(2.0, half)
        axes.errorbar(
            times, values, spread, fmt=look.marker, color=look.color, markersize=3.5, capsize=1.5, label=policy
        )
    axes.set_ylabel("Total gap\n(deg)")
    style.legend(axes, columns=5)


def _in_force(
    axes: Axes, ran: RunsByPolicy, value: Callable[[SettingChange], float], label: str, line: str = "-"
) -> None:
    """Draw a value of the setting in force, one staircase per policy."""
    for policy, run in sorted(ran, key=lambda one: -_LINE_STYLES[one[0]].width):
        look = _LINE_STYLES[policy]
        axes.step(*_stairs(run, value), line, where="post", color=look.color, linewidth=look.width, label=policy)
    axes.set_ylabel(label)


def _gains(axes: Axes, ran: RunsByPolicy, own: Gains) -> None:
    """Draw Kp and Ki relative to the servo's own."""
    _in_force(axes, ran, lambda change: change.gains.Ki / own.Ki, "", "--")
    _in_force(axes, ran, lambda change: change.gains.Kp / own.Kp, "Gain over\nown")
    kinds = [Line2D([], [], color=style.BLACK, linestyle=line) for line in ("-", "--")]
    style.legend(axes, handles=kinds, labels=["$K_p$ (and $K_d$)", "$K_i$"])
    _widen(axes, 0.0)


def _stairs(run: TwinRun, value: Callable[[SettingChange], float]) -> tuple[list[float], list[float]]:
    """Times and values; the last value lasts to the run's end."""
    values = [value(change) for change in run.changes]
    return [*(change.time for change in run.changes), float(run.trace.time[-1])], [*values, values[-1]]


def _widen(axes: Axes, least: float) -> None:
    """Widen the axis: room around lines at the edges, and at least `least` on either side of 0."""
    low, high = axes.dataLim.intervaly
    low, high = min(float(low), -least), max(float(high), least)
    room = 0.12 * (high - low)
    axes.set_ylim(low - room, high + room)


def _figure(name: str, title: str, circumstances: str, condition: LoopCondition) -> FigureSpec[PolicyComparison]:
    caption = (
        f"{circumstances} Every policy runs in the same co-simulation, sampled at 5 kHz, with the same machine, seed,"
        " link and estimator (ours; windows of 1 s, 2 s under certified). Only the policy differs, and its fallback"
        " set: certified begins on a fallback set that is verified in simulation for every gap of the stated range, and"
        " hysteresis falls back to the same set. The fallback set alone is certified with its twin off. (a) Reference;"
        " (b) to (f) reference minus true position, cut where the steps begin, and shaded where the step does not"
        " settle; (g) the gap and the accepted estimates with two standard deviations, moved"
        f" {APART:g} s apart; in force at the edge: (h) half-width of the dead zone, (i) gains relative to the servo's"
        " own, (j) feedforward."
    )
    return FigureSpec(name, title, caption, data_of(condition), plot, lambda d: d.outcomes)


FIGURES = (
    _figure("policies", "The policies on Fig 15's wear.", "No noise, no bias.", CLEAN),
    _figure("policies-noise", "The policies in Fig 16's noise.", "Noise and low-pass in the loop as in Fig 16.", NOISE),
    _figure(
        "policies-bias",
        "The policies with a bias on the motor's input.",
        f"No noise; {BIASED.input_bias * 1e3:g} mV are added to the voltage behind the controller.",
        BIASED,
    ),
)
