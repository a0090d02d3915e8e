"""Picture and page of an identified drive: its force, what the simulated loop leaves, and its friction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from servotwin.commissioning.commission import CommissionedAxis
from servotwin.estimation.inverse_dynamics.conditioning import low_passed, motion_of
from servotwin.report import style
from servotwin.report.page import page
from servotwin.runtime import files

_POINTS = 4000  # of a curve


def write_page(path: Path, found: CommissionedAxis, headline: str) -> None:
    """Write the picture (.png, .svg) or the page with it (.html), whole or not at all."""
    figure = picture(found)
    with files.atomic_output(path) as temporary:
        if path.suffix == ".html":
            temporary.write_text(_html(found, headline, style.svg(figure, path.stem)), encoding="utf-8")
        else:
            figure.savefig(temporary, format=path.suffix[1:], dpi=150)


def picture(found: CommissionedAxis) -> Any:
    """Figure of four panels: position, force, what the simulated loop leaves of the position, friction."""
    recording, band, refined = found.logs[0].recording, found.drive.bands[0], found.drive.refinement
    unit, force_unit = recording.unit, recording.force_unit
    time = np.arange(recording.position.size) / recording.rate
    force = low_passed(recording.force, band.corner, recording.rate)
    every = max(1, time.size // _POINTS)
    with style.look():
        figure = style.sheet(9.0, 6.4)
        axes = figure.subplots(2, 2)
        style.label_panels(axes.ravel())
        where, pushed, left, friction = axes.ravel()
        where.plot(time[::every], recording.position[::every], color=style.GREY, label="log")
        pushed.plot(time[::every], force[::every], color=style.GREY, label="log")
        if refined is not None:
            simulated = refined.simulated
            modelled = low_passed(simulated.force, band.corner, recording.rate)
            where.plot(time[::every], simulated.position[::every], color=style.BLUE, linestyle="--", label="simulated")
            pushed.plot(time[::every], modelled[::every], color=style.BLUE, linewidth=0.8, label="simulated")
            style.trace(left, time, recording.position - simulated.position, style.BLUE, linewidth=0.6)
        _draw_friction(friction, found, force)
        where.legend()
        where.set(xlabel="Time (s)", ylabel=f"Position ({unit})")
        pushed.set(xlabel="Time (s)", ylabel=f"Force below {band.corner:.3g} Hz ({force_unit})")
        left.set(xlabel="Time (s)", ylabel=f"Position, log - simulated ({unit})")
        friction.set(xlabel=f"Speed ({unit}/s)", ylabel=f"Force without inertia's ({force_unit})")
    return figure


def _draw_friction(axes: Any, found: CommissionedAxis, force: Any) -> None:
    """Force less that of the acceleration, and the two models."""
    recording, band, fit, sides = found.logs[0].recording, found.drive.bands[0], found.best, found.asymmetric
    motion = motion_of(recording.position, recording.rate, band)
    speed, acceleration = low_passed(
        np.column_stack([motion.speed, motion.acceleration]), band.corner, recording.rate
    ).T  # fmt: skip
    every = max(1, speed.size // _POINTS)
    axes.plot(speed[::every], (force - fit["inertia"] * acceleration)[::every], ".", markersize=1.2, color=style.GREY)
    fastest = float(np.abs(speed).max())
    for side, name in ((1.0, "forward"), (-1.0, "backward")):
        line = side * np.linspace(0.0, fastest, 2)
        axes.plot(line, fit["viscous"] * line + side * fit["coulomb"] + fit["offset"], color=style.BLUE)
        axes.plot(line, sides[f"viscous_{name}"] * line + side * sides[f"coulomb_{name}"], color=style.ORANGE, ls="--")


def _html(found: CommissionedAxis, headline: str, vector: bytes) -> str:
    return page(
        "drive.html",
        "servotwin: commissioned drive",
        logs=", ".join(log.recording.source.removeprefix("log ") for log in found.logs),
        headline=headline,
        doubts=found.drive.doubts,
        advice=str(found.drive.advice),
        picture=vector,
    )
