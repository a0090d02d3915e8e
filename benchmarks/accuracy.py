"""`servotwin bench estimator`: every figure of the default estimator beside its target."""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.estimator import table
from benchmarks.estimator_figures import Figure

SCHEMA = "servotwin-bench-estimator/1"
NAME = "estimator"


def accuracy(
    date: str = "", output: Path | None = None, size: float = 1.0, console: Console | None = None
) -> tuple[Figure, ...]:
    """Measure, show as it comes, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    size : float
        Share of the full number of windows.
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    figures = []
    with console.status("estimating") as status:
        for figure in table(size):
            figures.append(figure)
            status.update(f"estimating, {len(figures)} figures so far")
    console.print(shown(figures))
    if size < 1.0:
        console.print(f"With {size:.0%} of the windows, shares and coverages scatter about their targets.")
    report.write(output, dumps(figures, date, size), console)
    return tuple(figures)


def shown(figures: list[Figure]) -> Table:
    """The figures as a table for the terminal."""
    result = Table(title="estimator: accuracy of the default method", title_justify="left", box=None, pad_edge=False)
    result.add_column("what")
    for heading in ("measured", "target", "windows"):
        result.add_column(heading, justify="right")
    result.add_column("")
    for figure in figures:
        judged = "" if not limited(figure) else "met" if figure.met else "missed"
        result.add_row(figure.name, f"{figure.value:.4g}", target(figure), str(figure.windows), judged)
    return result


def limited(figure: Figure) -> bool:
    """Decide: the figure has a target."""
    return any(math.isfinite(end) for end in figure.target)


def target(figure: Figure) -> str:
    """The target in words."""
    low, high = figure.target
    if not limited(figure):
        return ""
    if math.isinf(low) or low == high == 0.0 or (low == 0.0 and math.isfinite(high)):
        return f"<= {high:g}"
    return f">= {low:g}" if math.isinf(high) or low == high else f"{low:g} .. {high:g}"


def dumps(figures: list[Figure], date: str, size: float) -> str:
    """The document: schema, date, machine, and every figure with its target (null: none)."""
    rows = [
        {
            "name": figure.name,
            "value": figure.value,
            "target": figure.target,
            "met": figure.met if limited(figure) else None,
            "windows": figure.windows,
            "remark": figure.remark,
        }
        for figure in figures
    ]
    return report.text(SCHEMA, date, size=size, figures=rows)
