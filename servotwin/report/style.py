"""Style of every figure: sizes, panels, decimated traces, files."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import ArrayLike, NDArray

from servotwin.hybrid.automaton import Array
from servotwin.report import theme
from servotwin.runtime import files

Complex = NDArray[np.complex128]

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = theme.OKABE_ITO
GREY = theme.GREY
MM, DEG = 1e3, float(np.degrees(1.0))  # from m and rad

_LOOK: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": theme.GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "savefig.facecolor": "white",
    "path.simplify": True,
}


@contextmanager
def look() -> Iterator[None]:
    """Apply the style inside this block."""
    with matplotlib.rc_context(_LOOK):
        yield


def panels(
    rows: int, columns: int = 1, height: float = 2.3, heights: Sequence[float] | None = None, share: bool = True
) -> tuple[Figure, NDArray[Any]]:
    """Make a figure 7.2 inches wide and its axes (rows, columns); `height` in inches per row, `heights` relative."""
    figure = sheet(7.2, height * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex="col" if share else False, height_ratios=heights)
    return figure, axes


def label_panels(axes: Sequence[Axes]) -> None:
    """Write (a), (b), ... at the panels' upper left, beside the titles."""
    for one, name in zip(axes, "abcdefghij", strict=False):
        one.set_title(f"({name})", loc="left", fontweight="bold")


def envelope(time: ArrayLike, values: ArrayLike, columns: int = 1200) -> tuple[NDArray[Any], NDArray[Any]]:
    """Reduce a signal to the least and greatest sample per column, in their order: a screen shows no more."""
    time, values = np.asarray(time), np.asarray(values)
    if values.size <= 4 * columns:
        return time, values
    width = -(-values.size // columns)
    padded = np.pad(values, (0, -values.size % width), mode="edge").reshape(-1, width)
    inside = np.sort(np.stack([padded.argmin(axis=1), padded.argmax(axis=1)], axis=1), axis=1)
    keep = (inside + np.arange(len(padded))[:, None] * width).ravel()
    keep = np.concatenate([[0], np.minimum(keep, values.size - 1), [values.size - 1]])
    keep = np.unique(keep)
    return time[keep], values[keep]


def trace(axes: Axes, time: ArrayLike, values: ArrayLike, color: str, label: str | None = None, **how: Any) -> None:
    """Plot a long signal, reduced to its envelope."""
    axes.plot(*envelope(time, values), color=color, label=label, **how)


def sheet(width: float, height: float) -> Figure:
    """Make an empty figure; size in inches."""
    return Figure(figsize=(width, height), layout="constrained")


def bode(upper: Axes, lower: Axes, omega: Array, response: Complex, color: str, label: str) -> None:
    """Draw magnitude in dB above and unwrapped phase below, over frequency in rad/s."""
    upper.semilogx(omega, 20.0 * np.log10(np.abs(response)), color=color)
    upper.set_ylabel(label)
    lower.semilogx(omega, np.degrees(np.unwrap(np.angle(response))), color=color)
    lower.set(ylabel="Phase (deg)", xlabel="Frequency (rad/s)", xlim=(omega[0], omega[-1]))
    span = float(np.ptp(lower.get_ylim()))
    lower.yaxis.set_major_locator(MultipleLocator(90.0 if span > 180.0 else 30.0))


def legend(axes: Axes, columns: int = 4, **how: Any) -> None:
    """Draw the legend in one line above the axes, where it covers no data."""
    spacing = {"borderaxespad": 0.2, "handlelength": 1.5, "columnspacing": 1.0, "handletextpad": 0.5}
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, **spacing, **how)


def svg(figure: Figure, name: str) -> bytes:
    """Encode the figure as a vector image; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({**_LOOK, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def save(figure: Figure, directory: Path, name: str) -> Path:
    """Write NAME.svg and NAME.png (200 dots per inch); returns the path of the SVG."""
    vector = directory / f"{name}.svg"
    with files.atomic_output(vector) as temporary:
        temporary.write_bytes(svg(figure, name))
    figure.set_layout_engine("none")  # what was laid out for the first file stays: it takes longer than drawing
    with files.atomic_output(directory / f"{name}.png") as temporary, look():
        figure.savefig(temporary, format="png", dpi=200)
    return vector
