"""Figs 15 and 16: the twin follows the wearing gap, without and with measurement noise; then with our estimator."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.runs import Runs
from servotwin.reproduction.twin_runs import CONTINUOUS, NOISY, OURS, PUBLISHED, SAMPLED, TwinJob, TwinRun


@dataclass(frozen=True, eq=False)
class TwinComparison:
    """The published twin's runs, the run with our estimator, and the pitch (m/rad) that ties a tolerance to a gap.

    Fig 16 has no continuous run: `published` is one run there, two in Fig 15.
    """

    published: tuple[TwinRun, ...]
    ours: TwinRun
    pitch: float


def fig15_data(runs: Runs) -> TwinComparison:
    """Run the packaged scenarios with this preset: continuous and sampled, then continuous with our estimator."""
    published = tuple(runs.get(TwinJob(runs.preset, name)) for name in (CONTINUOUS, SAMPLED))
    return TwinComparison(published, runs.get(TwinJob(runs.preset, CONTINUOUS, method=OURS)), runs.servo.p)


def fig16_data(runs: Runs) -> TwinComparison:
    """Run the packaged scenario with noise with this preset, with both estimators."""
    noisy, ours = (runs.get(TwinJob(runs.preset, NOISY, method=method)) for method in (PUBLISHED, OURS))
    return TwinComparison((noisy,), ours, runs.servo.p)


def _fig15_plot(d: TwinComparison) -> Figure:
    continuous, sampled = d.published
    figure, panels = wear_panels.sheet(6)
    wear_panels.position(panels[0], continuous.trace, "position $q_3$, continuous controller")
    wear_panels.position(panels[1], sampled.trace, "position $q_3$, controller sampled at 5 kHz")
    wear_panels.gaps(panels[2], continuous, d.pitch)
    wear_panels.position(panels[3], d.ours.trace, "position $q_3$, with our estimator")
    wear_panels.gaps(panels[4], d.ours, d.pitch)
    wear_panels.errors(panels[5], continuous, d.ours)
    for panel in (panels[2], panels[4]):
        style.legend(panel)
    return figure


def _fig16_plot(d: TwinComparison) -> Figure:
    (noisy,) = d.published
    figure, panels = wear_panels.sheet(5)
    wear_panels.position(panels[0], noisy.trace)
    wear_panels.gaps(panels[1], noisy, d.pitch)
    wear_panels.position(panels[2], d.ours.trace, "position $q_3$, with our estimator")
    wear_panels.gaps(panels[3], d.ours, d.pitch)
    wear_panels.errors(panels[4], noisy, d.ours)
    for panel in (panels[1], panels[3]):
        style.legend(panel)
    return figure


FIGURES = (
    FigureSpec(
        "fig15",
        "Fig 15. The twin keeps the dead zone up to date.",
        "Position while the gap wears and the twin's estimates set the dead zone 3 s after each step: (a) with the"
        " paper's continuous controller, (b) with the sampled one; (c) from run (a): the gap, the twin's estimates (at"
        " the middle of their windows) and the gap for which the dead zone in force is made. Then run (a) again with"
        " our estimator, for which the motor's angle is sent with 32 bits instead of 16: (d) position, (e) gap and"
        " estimates. (f) Errors of both estimators, and half the width of the 95 % intervals that they state; errors"
        f" below {wear_panels.FAINTEST:g} deg are drawn at that value.",
        fig15_data,
        _fig15_plot,
    ),
    FigureSpec(
        "fig16",
        "Fig 16. With measurement noise.",
        "As Fig 15 with the sampled controller, noise of 0.22 mm (high-passed between 10 and 50 Hz) on the measured"
        " position, a 20 Hz low-pass in the loop and a zero-phase low-pass in the twin: (a) the true position, (b) gap"
        " and estimates. Then with our estimator, which needs no low-pass: (c) position, (d) gap and estimates; where a"
        " window does not fit the model, its estimate is refused and the dead zone stays. (e) Errors of both"
        " estimators, and half the width of the 95 % intervals that they state.",
        fig16_data,
        _fig16_plot,
    ),
)
