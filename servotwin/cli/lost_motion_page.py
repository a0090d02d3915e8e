"""Picture and page of a gap between two encoders: loop, residual, reversals and profile."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from servotwin.cli.lost_motion import model_line, model_rows, read_line
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.wind_up import TransmissionGap
from servotwin.logs.recordings import RecordedLog
from servotwin.report import style
from servotwin.report.page import page
from servotwin.report.panels import write_panels

_NOT_SHOWN = "not known with this model"
_DRAWN_IN = {"m": ("mm", 1e3)}
"""Units of logs that would need ticks of many digits: unit and factor of the axes."""


def write_page(path: Path, log: RecordedLog, found: TransmissionGap, headline: str) -> None:
    """Write the picture (.png, .svg) or the page with it (.html), whole or not at all."""
    unit, factor = _DRAWN_IN.get(log.recording.load_unit, (log.recording.load_unit, 1.0))
    draws = [
        partial(draw, lost=found.lost, unit=unit, factor=factor)
        for draw in (_draw_loop, _draw_reversals, _draw_left, _draw_profile)
    ]
    write_panels(path, draws, partial(_html, log, found, headline))


def _draw_loop(axes: Axes, lost: LostMotion, unit: str, factor: float) -> None:
    """Motor's lead over the load's position."""
    if lost.curves is not None:
        lead = factor * lost.curves.lead * abs(lost.ratio)
        axes.plot(factor * lost.curves.load, lead, ".", markersize=1.2, color=style.GREY, rasterized=True)
        for side in (-0.5, 0.5):
            axes.axhline(factor * side * lost.at_load, color=style.BLUE)
    axes.set(ylabel=f"Motor's lead, at the load ({unit})")
    _over_position(axes, unit)


def _draw_reversals(axes: Axes, lost: LostMotion, unit: str, factor: float) -> None:
    """Lost motion of each reversal."""
    low, high = (factor * end for end in lost.interval_load)
    if np.isfinite(high):
        axes.axhspan(low, high, color=style.SKY, alpha=0.4, linewidth=0.0, label="95 % interval")
    gaps = [factor * each.gap * abs(lost.ratio) for each in lost.local]
    axes.plot([factor * each.position for each in lost.local], gaps, "o", markersize=3.0, color=style.BLUE)
    _say_unless(axes, bool(lost.local))
    most = max([*gaps, high if np.isfinite(high) else 0.0])
    axes.set(ylabel=f"Lost motion ({unit})", ylim=(0.0, 1.1 * most or None))
    _over_position(axes, unit)


def _over_position(axes: Axes, unit: str) -> None:
    """Show the load's position along x."""
    axes.set(xlabel=f"Load position ({unit})")
    axes.ticklabel_format(axis="x", scilimits=(-2, 4))


def _draw_left(axes: Axes, lost: LostMotion, unit: str, factor: float) -> None:
    """Residual over time."""
    if lost.curves is not None:
        style.trace(axes, lost.curves.time, factor * lost.curves.residual, style.GREY)
    axes.set(xlabel="Time (s)", ylabel=f"Residual of the model ({unit})")


def _draw_profile(axes: Axes, lost: LostMotion, unit: str, factor: float) -> None:
    """Error of the model over the lost motion."""
    low, high = (factor * end for end in lost.interval_load)
    if lost.curves is not None:
        axes.plot(factor * lost.curves.gaps * abs(lost.ratio), factor * lost.curves.rms, color=style.BLUE)
    if np.isfinite(high):
        axes.axvspan(low, high, color=style.SKY, alpha=0.4, linewidth=0.0)
    _say_unless(axes, lost.curves is not None and lost.curves.gaps.size > 0)
    axes.set(xlabel=f"Lost motion ({unit})", ylabel=f"rms error of the model ({unit})", ylim=(0.0, None))


def _say_unless(axes: Axes, known: bool) -> None:
    if not known:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, _NOT_SHOWN, transform=axes.transAxes, ha="center", va="center", color=style.GREY)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _html(log: RecordedLog, found: TransmissionGap, headline: str, images: list[bytes]) -> str:
    unit = log.recording.load_unit
    read = [read_line(log)]
    if found.lost.comparisons:
        read.append(model_line(found, unit, log.recording.motor_unit))
    return page(
        "lost_motion.html",
        "servotwin: lost motion",
        heading=f"{'Gap' if found.ok else 'Lost motion'} of {log.recording.source.removeprefix('log ')}",
        headline=_sentence(headline),
        sentences=[_sentence(each) for each in (*found.reasons, *read)],
        images=images,
        unit=unit,
        models=model_rows(found),
        defects=[(defect, str(count)) for defect, count in log.found.items()],
    )
