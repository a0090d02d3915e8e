"""Picture and page of a gap between two encoders: loop, residual, reversals and profile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from servotwin.cli.lost_motion import model_line, model_rows, read_line
from servotwin.estimation.kinematic.wind_up import TransmissionGap
from servotwin.logs.recordings import RecordedLog
from servotwin.report import style
from servotwin.report.page import page
from servotwin.runtime import files

_NOT_SHOWN = "not known with this model"
_SUFFIXES = (".html", ".png", ".svg")


def check_page(path: Path) -> None:
    """Check the name before anything is computed.

    Raises
    ------
    InvalidInput
        Unknown suffix or missing folder.
    """
    files.check_file(path, _SUFFIXES)


def write_page(path: Path, log: RecordedLog, found: TransmissionGap, headline: str) -> None:
    """Write the picture (.png, .svg) or the page with it (.html), whole or not at all."""
    figure = picture(log, found)
    with files.atomic_output(path) as temporary:
        if path.suffix == ".html":
            temporary.write_text(_html(log, found, headline, style.svg(figure, path.stem)), encoding="utf-8")
        else:
            figure.savefig(temporary, format=path.suffix[1:], dpi=150)


def picture(log: RecordedLog, found: TransmissionGap) -> Any:
    """Figure of four panels: hysteresis loop, gap of each reversal, what the model leaves, error over the gap."""
    recording, lost, scale = log.recording, found.lost, abs(found.lost.ratio)
    curves = lost.curves
    unit = recording.load_unit
    with style.look():
        figure = style.sheet(9.0, 6.4)
        axes = figure.subplots(2, 2)
        style.label_panels(axes.ravel())
        loop, local, left, profile = axes.ravel()
        if curves is not None:
            loop.plot(curves.load, curves.lead * scale, ".", markersize=1.2, color=style.GREY, rasterized=True)
            for side in (-0.5, 0.5):
                loop.axhline(side * lost.at_load, color=style.BLUE)
            style.trace(left, curves.time, curves.residual, style.GREY)
            profile.plot(curves.gaps * scale, curves.rms, color=style.BLUE)
        low, high = lost.interval_load
        if np.isfinite(high):
            profile.axvspan(low, high, color=style.SKY, alpha=0.4, linewidth=0.0)
            local.axhspan(low, high, color=style.SKY, alpha=0.4, linewidth=0.0, label="95 % interval")
        local.plot([each.position for each in lost.local], [each.gap * scale for each in lost.local], "o",
                   markersize=3.0, color=style.BLUE)  # fmt: skip
        for panel, known in ((local, lost.local), (profile, curves is not None and curves.gaps.size)):
            if not known:
                panel.text(0.5, 0.5, _NOT_SHOWN, transform=panel.transAxes, ha="center", va="center", color=style.GREY)
        loop.set(xlabel=f"Load position ({unit})", ylabel=f"Motor's lead, at the load ({unit})")
        local.set(xlabel=f"Load position ({unit})", ylabel=f"Lost motion ({unit})", ylim=(0.0, None))
        left.set(xlabel="Time (s)", ylabel=f"Left by the model ({unit})")
        profile.set(xlabel=f"Lost motion ({unit})", ylabel=f"rms error of the model ({unit})", ylim=(0.0, None))
    return figure


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _html(log: RecordedLog, found: TransmissionGap, headline: str, vector: bytes) -> str:
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
        picture=vector,
        unit=unit,
        models=model_rows(found),
        defects=[(str(count), defect) for defect, count in log.found.items()],
    )
