"""Picture and page of an identified drive: its force, what the simulated loop leaves, and its friction."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from servotwin.commissioning.commission import CommissionedAxis
from servotwin.estimation.inverse_dynamics.conditioning import low_passed, motion_of
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array
from servotwin.report import style
from servotwin.report.page import page
from servotwin.report.panels import write_panels

_POINTS = 4000  # of a curve


class _Unit(NamedTuple):
    """Unit of positions in a picture, and its number per m or rad."""

    name: str
    factor: float


_POSITION = {False: _Unit("mm", 1e3), True: _Unit("deg", math.degrees(1.0))}  # by DriveRecording.rotary
_ERROR = {False: _Unit("um", 1e6), True: _Unit("mdeg", 1e3 * math.degrees(1.0))}


def write_page(path: Path, found: CommissionedAxis, headline: str) -> None:
    """Write the picture (.png, .svg) or the page with it (.html), whole or not at all."""
    draws = [partial(draw, found=found) for draw in (_draw_position, _draw_force, _draw_left, _draw_friction)]
    write_panels(path, draws, partial(_html, found, headline))


def _times(recording: DriveRecording) -> Array:
    return np.arange(recording.position.size) / recording.rate


def _shown(values: Array) -> Array:
    return values[:: max(1, values.size // _POINTS)]


def _draw_position(axes: Axes, found: CommissionedAxis) -> None:
    recording, refined = found.logs[0].recording, found.drive.refinement
    time, unit = _shown(_times(recording)), _POSITION[recording.rotary]
    axes.plot(time, unit.factor * _shown(recording.position), color=style.GREY, label="log")
    if refined is not None:
        simulated = unit.factor * _shown(refined.simulated.position)
        axes.plot(time, simulated, color=style.BLUE, linestyle="--", label="simulated")
    style.legend(axes)
    axes.set(xlabel="Time (s)", ylabel=f"Position ({unit.name})")


def _draw_force(axes: Axes, found: CommissionedAxis) -> None:
    """Both forces pass the filter of the fit."""
    recording, corner, refined = found.logs[0].recording, found.drive.bands[0].corner, found.drive.refinement
    time = _shown(_times(recording))
    axes.plot(time, _shown(_filtered(found, recording.force)), color=style.GREY, label="log")
    if refined is not None:
        modelled = _filtered(found, refined.simulated.force)
        axes.plot(time, _shown(modelled), color=style.BLUE, linewidth=0.8, label="simulated")
    axes.set(xlabel="Time (s)", ylabel=f"Force below {corner:.3g} Hz ({recording.force_unit})")


def _draw_left(axes: Axes, found: CommissionedAxis) -> None:
    recording, refined = found.logs[0].recording, found.drive.refinement
    unit = _ERROR[recording.rotary]
    if refined is not None:
        left = unit.factor * (recording.position - refined.simulated.position)
        style.trace(axes, _times(recording), left, style.BLUE, linewidth=0.6)
    axes.set(xlabel="Time (s)", ylabel=f"Position, log less simulated ({unit.name})")


def _filtered(found: CommissionedAxis, force: Array) -> Array:
    return low_passed(force, found.drive.bands[0].corner, found.logs[0].recording.rate)


def _draw_friction(axes: Axes, found: CommissionedAxis) -> None:
    """Force less that of the acceleration, and the two models."""
    recording, band, fit, sides = found.logs[0].recording, found.drive.bands[0], found.best, found.asymmetric
    motion = motion_of(recording.position, recording.rate, band)
    speed, acceleration, force = (
        _filtered(found, each) for each in (motion.speed, motion.acceleration, recording.force)
    )
    left = force - fit["inertia"] * acceleration
    axes.plot(_shown(speed), _shown(left), ".", markersize=1.2, color=style.GREY)
    fastest = float(np.abs(speed).max())
    for side, name in ((1.0, "forward"), (-1.0, "backward")):
        line = side * np.linspace(0.0, fastest, 2)
        axes.plot(line, fit["viscous"] * line + side * fit["coulomb"] + fit["offset"], color=style.BLUE)
        axes.plot(line, sides[f"viscous_{name}"] * line + side * sides[f"coulomb_{name}"], color=style.ORANGE, ls="--")
    axes.set(xlabel=f"Speed ({recording.unit}/s)", ylabel=f"Force without inertia's ({recording.force_unit})")


def _html(found: CommissionedAxis, headline: str, images: list[bytes]) -> str:
    return page(
        "drive.html",
        "servotwin: commissioned drive",
        logs=", ".join(log.recording.source.removeprefix("log ") for log in found.logs),
        headline=headline,
        doubts=found.drive.doubts,
        advice=str(found.drive.advice),
        images=images,
    )
