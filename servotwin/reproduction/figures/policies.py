"""Beyond the paper: the policies on one wear, each in the same loop; what they leave, and what they sent."""

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
from servotwin.reproduction.beyond import ALONE, BIASED, CLEAN, CONTESTANTS, NOISE, Condition, Outcome, PolicyJob, worst
from servotwin.reproduction.figures import worn
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.inforce import Change
from servotwin.reproduction.loops import Record
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import AMPLITUDE, DURATION, Runs


class Look(NamedTuple):
    """Colour, line width and marker; widths differ so that equal lines show through."""

    color: str
    width: float
    marker: str


LOOKS = {
    "paper": Look(style.ORANGE, 3.4, "s"),
    "margin": Look(style.GREEN, 2.6, "^"),
    "hysteresis": Look(style.PINK, 1.8, "D"),
    "certified": Look(style.BLUE, 1.0, "o"),
    ALONE: Look(style.SKY, 4.2, "v"),
}
APART = 1.5  # s, between markers that would hide one another
LEAST = 2e-5  # m: the errors' axis never shows less

Policied = list[tuple[str, Record]]


@dataclass(frozen=True, eq=False)
class Data:
    """What came of each policy, the servo's own gains, and the reference."""

    outcomes: tuple[Outcome, ...]
    own: Gains
    time: Array
    reference: Array
    gap: Array


def data_of(condition: Condition, duration: float = DURATION) -> Callable[[Runs], Data]:
    """The data of the figure for a condition."""

    def data(runs: Runs) -> Data:
        outcomes = tuple(runs.get(PolicyJob(runs.preset, policy, condition, duration)) for policy in CONTESTANTS)
        trace = next(one.record.trace for one in outcomes if one.record is not None)
        law = runs.servo.controller
        own = Gains(law.Kp, law.Ki, law.Kd, law.Tf)
        return Data(outcomes, own, trace.time, trace.reference, trace.gap)

    return data


def plot(d: Data) -> Figure:
    """Reference, one error per policy, gap and estimates, and what was in force: dead zone, gains, feedforward."""
    heights = (0.6, *(0.8 for _ in d.outcomes), 1.3, 1.0, 1.0, 1.0)
    figure, grid = style.panels(len(heights), 1, height=1.2, heights=heights)
    panels = list(grid[:, 0])
    reference, errors, (gap, tolerance, gains, feedforward) = panels[0], panels[1:-4], panels[-4:]
    _reference(reference, d)
    reach = _reach(d.outcomes)
    for axes, outcome in zip(errors, d.outcomes, strict=True):
        _error(axes, outcome, reach)
    ran = [(one.policy, one.record) for one in d.outcomes if one.record is not None]
    _gap(gap, ran, d)
    _in_force(tolerance, ran, lambda change: change.tolerance * style.MM, "Dead zone\n(mm)")
    style.legend(tolerance, columns=5)
    _gains(gains, ran, d.own)
    _in_force(feedforward, ran, lambda change: change.gains.feedforward * 1e3, "Feedforward\n(mV)")
    _widen(feedforward, 10.0)
    panels[-1].set(xlabel="Time (s)", xlim=(0.0, float(d.time[-1])))
    panels[-1].xaxis.set_major_locator(MultipleLocator(20.0))
    style.letter(panels)
    figure.align_ylabels(panels)
    return figure


def _reference(axes: Axes, d: Data) -> None:
    axes.plot(*worn.held(d.time[:-1], d.reference[:-1] * style.MM), color=style.BLACK)
    axes.set(ylabel="Reference\n(mm)", ylim=(-1.4 * AMPLITUDE * style.MM, 1.4 * AMPLITUDE * style.MM))


def _reach(outcomes: Sequence[Outcome]) -> float:
    """Half the errors' axis, m: what any policy leaves, with some room."""
    left = [step.error for one in outcomes for step in one.steps]
    return 1.3 * max([LEAST, *left])


def _error(axes: Axes, outcome: Outcome, reach: float) -> None:
    """Reference minus position; steps that did not settle are shaded."""
    axes.set(ylabel="Error\n(mm)", ylim=(-reach * style.MM, reach * style.MM))
    axes.set_title(_told(outcome), loc="right", fontsize=8.0)
    if outcome.record is None:
        axes.grid(False)
        text = "\n".join(textwrap.wrap(outcome.refused, 110))
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=7.5, color=style.BLACK)
        return
    trace = outcome.record.trace
    for step in trace.steps:
        if not step.settled:
            axes.axvspan(step.begin, step.end, color=style.GREY, alpha=0.22, linewidth=0.0)
    error = (trace.reference - trace.position)[:-1] * style.MM
    style.trace(axes, trace.time[:-1], error, LOOKS[outcome.policy].color, linewidth=0.9)


def _told(outcome: Outcome) -> str:
    """The policy and what came of it, in a line."""
    if outcome.record is None:
        return f"{outcome.policy}: designs nothing here"
    settled, left = sum(step.settled for step in outcome.steps), worst(outcome.steps, "error") * style.MM
    return f"{outcome.policy}: {settled} of {len(outcome.steps)} steps settle, at most {left:.2g} mm are left"


def _gap(axes: Axes, ran: Policied, d: Data) -> None:
    """The truth, and every policy's estimates, side by side at one time."""
    style.trace(axes, d.time, d.gap * style.DEG, style.BLACK, "actual gap")
    answered = [(policy, record) for policy, record in ran if record.estimates]
    for later, (policy, record) in enumerate(answered):
        known = [one for one in record.estimates if one.ok]
        times = [one.time + APART * later for one in known]
        values, half = ([getattr(one, name) * style.DEG for one in known] for name in ("gap", "std"))
        look = LOOKS[policy]
        spread = np.multiply(2.0, half)
        axes.errorbar(
            times, values, spread, fmt=look.marker, color=look.color, markersize=3.5, capsize=1.5, label=policy
        )
    axes.set_ylabel("Total gap\n(deg)")
    style.legend(axes, columns=5)


def _in_force(axes: Axes, ran: Policied, value: Callable[[Change], float], label: str, line: str = "-") -> None:
    """What was in force, a staircase per policy."""
    for policy, record in sorted(ran, key=lambda one: -LOOKS[one[0]].width):
        look = LOOKS[policy]
        axes.step(*_stairs(record, value), line, where="post", color=look.color, linewidth=look.width, label=policy)
    axes.set_ylabel(label)


def _gains(axes: Axes, ran: Policied, own: Gains) -> None:
    """Kp and Ki in the servo's own."""
    _in_force(axes, ran, lambda change: change.gains.Ki / own.Ki, "", "--")
    _in_force(axes, ran, lambda change: change.gains.Kp / own.Kp, "Gain over\nown")
    kinds = [Line2D([], [], color=style.BLACK, linestyle=line) for line in ("-", "--")]
    style.legend(axes, handles=kinds, labels=["$K_p$ (and $K_d$)", "$K_i$"])
    _widen(axes, 0.0)


def _stairs(record: Record, value: Callable[[Change], float]) -> tuple[list[float], list[float]]:
    """Times and values, the last value up to the run's end."""
    values = [value(change) for change in record.changes]
    return [*(change.time for change in record.changes), float(record.trace.time[-1])], [*values, values[-1]]


def _widen(axes: Axes, least: float) -> None:
    """Room around lines at the edges, and `least` either side of 0 at the least."""
    low, high = axes.dataLim.intervaly
    low, high = min(float(low), -least), max(float(high), least)
    room = 0.12 * (high - low)
    axes.set_ylim(low - room, high + room)


def _plate(name: str, title: str, what: str, condition: Condition) -> Plate[Data]:
    caption = (
        f"{what} Every policy runs in the same co-simulation, sampled at 5 kHz, with the same machine, seed, link and"
        " estimator (ours; windows of 1 s, those of certified 2 s). What differs is the policy, and what comes with it:"
        " certified begins on a fallback set that is proved for every gap of the stated range, and hysteresis falls"
        " back to the same one. The fallback set alone is certified with its twin off. (a) Reference; (b) to (f) its"
        " distance from the true position, cut where the steps begin, and shaded where the step does not settle; (g)"
        " the gap and the estimates that were accepted, with two standard deviations, moved"
        f" {APART:g} s apart; in force at the edge: (h) half-width of the dead zone, (i) gains in the servo's own,"
        " (j) feedforward."
    )
    return Plate(name, title, caption, data_of(condition), plot, lambda d: d.outcomes)


PLATES = (
    _plate("policies", "The policies on Fig 15's wear.", "No noise, no bias.", CLEAN),
    _plate("policies-noise", "The policies in Fig 16's noise.", "Noise and low-pass in the loop as in Fig 16.", NOISE),
    _plate(
        "policies-bias",
        "The policies with a bias on the motor's input.",
        f"No noise; {BIASED.input_bias * 1e3:g} mV are added to the voltage behind the controller.",
        BIASED,
    ),
)
