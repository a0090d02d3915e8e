"""Views of recorded signals: figures, pandas and Arrow tables. Their libraries are imported when a view is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servotwin.runtime.extras import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Panel(NamedTuple):
    """One axes of a figure: its label with the unit, and the curves by name.

    A name that begins with an underscore continues the curve before: same colour, no entry in the legend.
    """

    label: str
    curves: Mapping[str, Any]


def stacked_figure(title: str, time: Any, panels: Sequence[Panel]) -> Figure:
    """Figure with panels above each other on one time axis (s).

    Raises
    ------
    InvalidInput
        matplotlib is not installed.
    """
    pyplot = require("matplotlib.pyplot", "a figure")
    height = 1.0 + 1.8 * len(panels)
    figure, axes = pyplot.subplots(
        len(panels), 1, sharex=True, squeeze=False, figsize=(8.0, height), layout="constrained"
    )
    for panel, ax in zip(panels, axes[:, 0], strict=True):
        color = None
        for name, values in panel.curves.items():
            (line,) = ax.plot(time, values, label=name, linewidth=1.0, color=color if name.startswith("_") else None)
            color = line.get_color()
        ax.set_ylabel(panel.label)
        ax.grid(alpha=0.3)
        if len(panel.curves) > 1:
            legend_above(ax)
    figure.suptitle(title)
    axes[-1, 0].set_xlabel("time, s")
    return figure


def legend_above(axes: Axes) -> None:
    """Draw the legend above the axes, where it covers no data."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, fontsize="small", frameon=False, borderaxespad=0.2
    )


def pandas_table(columns: Mapping[str, Any]) -> Any:
    """``pandas.DataFrame`` of equally long columns.

    Raises
    ------
    InvalidInput
        pandas is not installed.
    """
    return require("pandas", "a pandas table").DataFrame(dict(columns))


def arrow_table(columns: Mapping[str, Any]) -> Any:
    """``pyarrow.Table`` of equally long columns.

    Raises
    ------
    InvalidInput
        pyarrow is not installed.
    """
    pyarrow = require("pyarrow", "an Arrow table")
    return pyarrow.table({name: np.ascontiguousarray(values) for name, values in columns.items()})
