"""Figure beyond the paper: information on the gap in a window with two contacts, with one, and with none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from servotwin.estimation.core.contacts import BY_GAP, BY_START, SCREW, Gap, contacts
from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.core.response import Response, response
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.whitened.reduction import Point, Reduction
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.report import style
from servotwin.reproduction.figures.spec import FigureSpec
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import AMPLITUDE, RATE, Runs
from servotwin.simulation import Run, simulate

GAP = math.radians(10.0)
FLOOR = 1e-6  # m: white noise on the position
_HALF_PERIOD = 6.0  # s, of the reference
SPAN = 1.0  # s, of a window
_WIDEST = math.radians(25.0)
GAPS, PLACES = 101, 61
CALM, _BEFORE_STEP = 0.0, 0.75  # integral gain over its own, and how long before the step the other windows begin, s


@dataclass(frozen=True, eq=False)
class WindowPanel:
    """One window.

    Attributes
    ----------
    title : str
    time : (n,) array
        s, from the window's first sample.
    theta_m, theta_d : (n,) arrays
        rad; the true screw.
    pushed : (n,) array
        +1 while the motor pushes the screw forwards, -1 backwards, 0 while the gap is open.
    raw, left : (n,) arrays
        Derivative of the position by the gap (m/rad); its part that no other unknown can imitate.
    spread : float
        rad: Cramer-Rao bound of the standard deviation in white noise of `FLOOR`; inf: no information.
    gaps, starts, misfit : (PLACES, GAPS) arrays
        rad, rad from the motor's first angle; root mean square residual, m.
    estimate : GapEstimate
    start : float
        rad: the screw's true first angle less the motor's.
    """

    title: str
    time: Array
    theta_m: Array
    theta_d: Array
    pushed: Array
    raw: Array
    left: Array
    spread: float
    gaps: Array
    starts: Array
    misfit: Array
    estimate: GapEstimate
    start: float


def estimator_data(runs: Runs) -> tuple[WindowPanel, ...]:
    """Simulate three windows: the paper's loop after a step; a calm loop around a step; the same loop at rest."""
    servo = runs.servo
    lively, calm = _run(servo, 1.0), _run(servo, CALM)
    return (
        _panel("two contacts", servo, lively, _HALF_PERIOD),
        _panel("one contact", servo, calm, _HALF_PERIOD - _BEFORE_STEP),
        _panel("at rest", servo, calm, _HALF_PERIOD - SPAN - 0.5),
    )


def _run(servo: Servo, integral: float) -> Run:
    controller = servo.controller.replace(Ki=integral * servo.controller.Ki)
    reference = SquareWave(AMPLITUDE, 2.0 * _HALF_PERIOD)
    return simulate(
        servo, _HALF_PERIOD + SPAN + 0.1, controller=controller, reference=reference, gap=GAP, sample_rate=RATE
    )


def _panel(title: str, servo: Servo, run: Run, start: float) -> WindowPanel:
    clean = Window.from_run(run, start, SPAN)
    noise = FLOOR * np.random.default_rng(0).standard_normal(clean.position.size)
    window = clean.replace(position=clean.position + noise)
    assert window.theta_m is not None
    first = round(start * RATE)
    theta_d = run.theta_d[first : first + window.theta_m.size]
    model = response(servo, RATE)
    raw, left = sensitivity(window.theta_m, Gap(GAP, float(theta_d[0])), model)
    size = float(np.linalg.norm(left))
    spread = FLOOR / size if size > 1e-9 * max(float(np.linalg.norm(raw)), 1e-300) else math.inf
    estimate = estimate_gap(window, servo)
    begun = float(theta_d[0] - window.theta_m[0])
    pushed = np.sign(window.theta_m - theta_d) * (np.abs(window.theta_m - theta_d) >= 0.5 * GAP * (1.0 - 1e-6))
    time = np.arange(theta_d.size) / RATE
    gaps, starts, misfit = cost(window, model)
    return WindowPanel(
        title=title,
        time=time,
        theta_m=window.theta_m,
        theta_d=theta_d,
        pushed=pushed,
        raw=raw,
        left=left,
        spread=spread,
        gaps=gaps,
        starts=starts,
        misfit=misfit,
        estimate=estimate,
        start=begun,
    )


def sensitivity(theta_m: Array, at: Gap, model: Response) -> tuple[Array, Array]:
    """Derivative of the position by the gap, (n,): whole, and its part that no other unknown can imitate.

    The other unknowns are the screw's start, the structure's initial state, the encoder's offset and a delay.
    """
    signals = contacts(theta_m, at)
    by_gap, by_start = model.respond(signals[[BY_GAP, BY_START]])
    late = model.velocities(signals[[SCREW]])
    others = np.vstack([by_start, np.ones(theta_m.size), model.free(theta_m.size), late])
    return by_gap, project_out(orthonormal(others), by_gap[None])[0]


def cost(window: Window, model: Response) -> tuple[Array, Array, Array]:
    """Gap, screw's start and rms residual, (PLACES, GAPS) each; the linear unknowns are at their best everywhere."""
    assert window.theta_m is not None
    misfit = Reduction.of(window.theta_m, window.position, model).coarse()
    gaps, places = np.meshgrid(np.linspace(0.0, _WIDEST, GAPS), np.linspace(-1.0, 1.0, PLACES))
    points = [Point(*pair) for pair in zip(gaps.ravel().tolist(), places.ravel().tolist(), strict=True)]
    squares = misfit.costs(points).reshape(gaps.shape)
    return gaps, 0.5 * gaps * places, np.sqrt(squares / misfit.position.size)


def plot(windows: Sequence[WindowPanel]) -> Figure:
    """Draw angles, sensitivity and misfit; one column per window."""
    figure, axes = style.panels(3, 3, height=2.3, heights=(1.0, 0.9, 1.35), share=False)
    reach = 1.1 * max(float(np.abs(panel.raw).max()) for panel in windows)
    for column, panel in zip(axes.T, windows, strict=True):
        _angles(column[0], panel)
        _contribution(column[1], panel, reach)
    meshes = [_misfit(one, panel) for one, panel in zip(axes[2], windows, strict=True)]
    for row, label in zip(axes[:, 0], ("Angle (deg)", "Position by gap (µm/deg)", "Screw's start (deg)"), strict=True):
        row.set_ylabel(label)
    figure.align_ylabels(axes[:, 0])
    figure.colorbar(meshes[0], ax=axes[2, :].tolist(), label="Misfit (µm rms)", location="bottom", aspect=50, pad=0.03)
    axes[0, 1].legend(loc="lower left")
    axes[1, 1].legend(loc="lower left")
    style.label_panels(axes[0])
    return figure


def _angles(axes: Axes, panel: WindowPanel) -> None:
    _shade(axes, panel)
    origin = float(panel.theta_m[0])
    style.trace(axes, panel.time, (panel.theta_m - origin) * style.DEG, style.BLUE, r"motor $\theta_m$")
    style.trace(axes, panel.time, (panel.theta_d - origin) * style.DEG, style.BLACK, r"screw $\theta_d$")
    axes.set(xlim=(0.0, SPAN), xticks=(0.0, 0.5, SPAN), title=panel.title)
    axes.tick_params(labelbottom=False)


def _shade(axes: Axes, panel: WindowPanel) -> None:
    """Shade contact forwards orange, contact backwards green."""
    for side, color in ((1.0, style.ORANGE), (-1.0, style.GREEN)):
        axes.fill_between(
            panel.time,
            0.0,
            1.0,
            where=(panel.pushed == side).tolist(),
            transform=axes.get_xaxis_transform(),
            color=color,
            alpha=0.25,
            linewidth=0.0,
        )


def _contribution(axes: Axes, panel: WindowPanel, reach: float) -> None:
    per_degree = 1e6 / style.DEG
    _shade(axes, panel)
    axes.plot(panel.time, panel.raw * per_degree, color=style.GREY, label="whole")
    axes.plot(panel.time, panel.left * per_degree, color=style.RED, label="the gap's alone")
    axes.set(
        xlabel="Time (s)", xlim=(0.0, SPAN), xticks=(0.0, 0.5, SPAN), ylim=(-reach * per_degree, reach * per_degree)
    )
    known = (
        f"at best ± {NORMAL_95 * panel.spread * style.DEG:.2g} deg (95 %)"
        if math.isfinite(panel.spread)
        else "shows nothing"
    )
    axes.set_title(known, loc="right", fontsize=8.0)


def _misfit(axes: Axes, panel: WindowPanel) -> QuadMesh:
    norm = LogNorm(0.1, 100.0)
    values = np.maximum(panel.misfit * 1e6, 0.1)
    gaps, starts = panel.gaps * style.DEG, panel.starts * style.DEG
    mesh = axes.pcolormesh(gaps, starts, values, norm=norm, cmap="viridis", shading="gouraud", rasterized=True)
    axes.contour(gaps, starts, values, levels=np.geomspace(0.2, 100.0, 12), colors="white", linewidths=0.4, alpha=0.7)
    axes.plot(GAP * style.DEG, panel.start * style.DEG, "o", color="white", markeredgecolor=style.BLACK, markersize=6)
    axes.set(xlabel="Gap (deg)", xlim=(0.0, _WIDEST * style.DEG), facecolor="#EEEEEE")
    axes.grid(False)
    axes.set_title(answer(panel.estimate), loc="right", fontsize=8.0)
    return mesh


def answer(estimate: GapEstimate) -> str:
    """Word the estimator's result in one line."""
    if estimate.ok:
        half = NORMAL_95 * estimate.std_total * style.DEG
        return f"OK: {estimate.gap * style.DEG:.3f} ± {half:.3f} deg (95 %)"
    if estimate.status is GapStatus.LOWER_BOUND:
        return f"at least {estimate.gap * style.DEG:.2g} deg"
    return estimate.status.value


FIGURE = FigureSpec(
    "estimator",
    "When a window shows the gap.",
    "Three windows of a loop with a gap of 10 deg and 1 µm of white noise. The motor pushes the screw (a) both ways,"
    " (b) one way, (c) not at all. Above: motor and screw, the contacts shaded (forwards orange, backwards green)."
    " Middle: the change of the position for a wider gap, and the part of it that no other unknown can imitate;"
    " above the panel the Cramer-Rao bound. Below: the misfit over the gap and the screw's first angle (from the"
    " motor's), all linear unknowns at their best; the dot is the truth; above the panel the estimator's result.",
    estimator_data,
    plot,
)
