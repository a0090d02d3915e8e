"""Pages and pictures of four panels: one sheet as a file, single panels on a page, which lays them out by its width."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servotwin.report import style
from servotwin.runtime import files

Draw = Callable[[Axes], Any]
SUFFIXES = (".html", ".png", ".svg")


def check_page(path: Path) -> None:
    """Check the name before anything is computed.

    Raises
    ------
    InvalidInput
        Unknown suffix or missing folder.
    """
    files.check_file(path, SUFFIXES)


def write_panels(path: Path, draws: Sequence[Draw], html: Callable[[list[bytes]], str]) -> None:
    """Write the sheet (.png, .svg), or the page that `html` makes of the single panels, whole or not at all."""
    with files.atomic_output(path) as temporary, style.look():
        if path.suffix == ".html":
            temporary.write_text(html(_apart(draws, path.stem)), encoding="utf-8")
        else:
            sheet(draws).savefig(temporary, format=path.suffix[1:], dpi=150)


def sheet(draws: Sequence[Draw]) -> Figure:
    """Draw four panels on one sheet."""
    with style.look():
        figure = style.sheet(9.0, 6.4)
        axes = figure.subplots(2, 2).ravel()
        style.label_panels(axes)
        for draw, each in zip(draws, axes, strict=True):
            draw(each)
    return figure


def _apart(draws: Sequence[Draw], name: str) -> list[bytes]:
    """Each panel as an image of its own."""
    images = []
    for place, draw in enumerate(draws):
        figure = style.sheet(4.5, 3.2)
        axes = figure.subplots()
        axes.set_title(f"({'abcd'[place]})", loc="left", fontweight="bold")
        draw(axes)
        images.append(style.svg(figure, f"{name}-{place}"))
    return images
