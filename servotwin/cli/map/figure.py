"""Picture of a map: curves over one axis, panels of colour over two, a sheet of small maps over more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from servotwin.analysis.maps.axes import RatioAxes
from servotwin.analysis.maps.result import StabilityMap
from servotwin.hybrid.automaton import Array
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.report import style
from servotwin.runtime import files

_LABELS = {
    "gap": ("gap (deg at the motor)", math.degrees(1.0)),
    "estimate": ("estimated gap (deg at the motor)", math.degrees(1.0)),
    "k_dz": ("$k_{DZ}$", 1.0),
}
_RATIO_LABELS = {"tolerance": ("tolerance / (p b)", 1.0), "amplitude": ("reference step / (p b)", 1.0)}
_DOT: Any = {"color": style.PINK, "linestyle": "", "marker": ".", "markersize": 2.5}
# Values within this factor are drawn alike.
_ALIKE = 1.01
# The horizontal axis is the one that a designer can choose: the dead zone.
_ACROSS = ("tolerance", "k_dz", "estimate", "gap", "amplitude")


@dataclass(frozen=True, eq=False)
class _PictureAxis:
    """An axis of the picture: its name, its label and its values in the label's unit."""

    name: str
    label: str
    values: Array

    @property
    def logarithmic(self) -> bool:
        """True where the values grow by ratios rather than by differences."""
        if self.values.size < 3 or self.values.min() <= 0.0:
            return False
        steps, ratios = np.diff(self.values), np.diff(np.log(self.values))
        return bool(np.ptp(ratios) / np.abs(ratios).mean() < np.ptp(steps) / np.abs(steps).mean())


def save(result: StabilityMap, directory: Path) -> Path:
    """Write map.png; returns its path."""
    path = directory / "map.png"
    with style.look():
        figure = draw(result)
        with files.atomic_output(path) as temporary:
            figure.savefig(temporary, format="png", dpi=150)
    return path


def draw(result: StabilityMap) -> Figure:
    """Draw the picture for the number of axes that vary."""
    varying = lines(result)
    if len(varying) == 1:
        return _curves(result, varying[0])
    if len(varying) == 2:
        return _panels(result, *_order(varying))
    return _sheet(result, varying)


def lines(result: StabilityMap) -> list[_PictureAxis]:
    """The axes that vary."""
    unit = position_unit(result.settings.servo)
    labels = _LABELS | {"amplitude": (f"reference step ({unit.name})", unit.factor)}
    labels = _RATIO_LABELS if isinstance(result.settings.axes, RatioAxes) else labels
    return [
        _PictureAxis(name, labels[name][0], np.array(values) * labels[name][1])
        for name, values in result.axes
        if len(values) > 1
    ]


def _order(pair: Sequence[_PictureAxis]) -> tuple[_PictureAxis, _PictureAxis]:
    """Across, up."""
    across, up = sorted(pair, key=lambda line: _ACROSS.index(line.name))
    return across, up


def _unit(result: StabilityMap) -> tuple[float, str]:
    """Unit of lengths and its name."""
    axes = result.settings.axes
    if isinstance(axes, RatioAxes):
        return 0.5 * result.settings.servo.p * axes.gap, "p b"
    unit = position_unit(result.settings.servo)
    return unit.si_of(1.0), unit.name


def _panels(result: StabilityMap, across: _PictureAxis, up: _PictureAxis) -> Figure:
    figure = style.sheet(7.2, 7.8)
    axes = figure.subplots(3, 2, sharex=True)
    unit, name = _unit(result)
    turned = [line.name for line in lines(result)].index(across.name) == 0

    def grid(measure: str) -> Array:
        """(up, across)."""
        values = result.grid(measure).squeeze()
        return values.T if turned else values

    _colour(axes[0, 0], across, up, grid("settled"), Normalize(0.0, 1.0))
    slow = grid("settled_short") > grid("settled")
    _mark(axes[0, 0], across, up, slow)
    _shares(axes[0, 1], across, grid("settled"), bool(slow.any()))
    error, swing = grid("error") / unit, grid("swing") / unit
    _colour(axes[1, 0], across, up, error, norm_of(error))
    _colour(axes[1, 1], across, up, swing, norm_of(swing, result.settings.stillness / unit))
    _colour(axes[2, 0], across, up, grid("settling"), norm_of(grid("settling"), 0.5))
    _colour(axes[2, 1], across, up, grid("effort"), norm_of(grid("effort")))
    titles = (
        "share of the runs that settle",
        f"over every {up.label.partition(' (')[0].partition(' /')[0]}",
        f"worst error at the end ({name})",
        f"worst half swing at the end ({name})",
        "worst 5 % settling time (s); white: never",
        _effort(result),
    )
    for one, letter, title in zip(axes.ravel(), "abcdef", titles, strict=True):
        one.set_title(f"({letter}) {title}", loc="left")
    for one in axes[0]:
        _rule(one, across)
    for one in axes[2]:
        one.set_xlabel(across.label)
    return figure


def _effort(result: StabilityMap) -> str:
    axes = result.settings.axes
    where = f" at a gap of {math.degrees(axes.gap):g} deg" if isinstance(axes, RatioAxes) else ""
    unit = command_unit(result.settings.servo)
    return f"{'voltage' if unit == 'V' else 'command'}{where} ({unit} rms)"


def norm_of(values: Array, least: float = 0.0) -> Normalize:
    """Logarithmic over three decades at most of the values that can be shown so, and from `least` on."""
    shown = values[np.isfinite(values) & (values > 0.0)]
    high = float(shown.max(initial=0.0))
    if high <= least or not high:  # no difference among these counts
        return Normalize(0.0, least or 1.0)
    low = max(float(shown.min()), least, high * 1e-3)
    if high < _ALIKE * low:  # differences in the last digits are no colours
        low, high = 0.5 * low, 2.0 * high
    return LogNorm(low, high, clip=True)


def _colour(axes: Axes, across: _PictureAxis, up: _PictureAxis, values: Array, norm: Normalize) -> None:
    image = axes.pcolormesh(
        across.values, up.values, np.where(np.isfinite(values), values, np.nan), norm=norm, rasterized=True,
        shading="nearest",
    )  # fmt: skip
    bar = axes.figure.colorbar(image, ax=axes, pad=0.02)
    bar.ax.tick_params(labelsize=7.5)
    if isinstance(norm, LogNorm):
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(up.label)
    _scales(axes, across, up)


def _scales(axes: Axes, across: _PictureAxis, up: _PictureAxis | None = None) -> None:
    axes.grid(False)
    if across.logarithmic:
        axes.set_xscale("log")
    if up is not None and up.logarithmic:
        axes.set_yscale("log")


def _rule(axes: Axes, across: _PictureAxis) -> None:
    """Add the paper's k_DZ, for a gap that is known exactly, along the top."""
    if across.name != "tolerance" or across.logarithmic:
        return
    above = axes.secondary_xaxis("top", functions=(lambda x: np.multiply(0.5, x), lambda k: np.multiply(2.0, k)))
    above.set_xlabel("$k_{DZ}$ = tolerance / (p gap)", fontsize=7.5, labelpad=2.0)
    above.tick_params(labelsize=7.5)


def _mark(axes: Axes, across: _PictureAxis, up: _PictureAxis, where: NDArray[np.bool_]) -> None:
    """Mark the cells in which a window of ten seconds would call more runs settled."""
    rows, columns = np.nonzero(where)
    axes.plot(across.values[columns], up.values[rows], **_DOT)


def _shares(axes: Axes, across: _PictureAxis, settled: Array, marked: bool) -> None:
    axes.plot(across.values, 100.0 * settled.mean(axis=0), color=style.BLUE, label="runs that settle")
    full = 100.0 * np.mean(settled == 1.0, axis=0)
    axes.plot(across.values, full, color=style.RED, label="cells in which all do")
    if marked:
        axes.plot([], [], label="in (a): rests over 10 s, then moves on", **_DOT)
    axes.set(ylabel="%", ylim=(-36.0, 104.0), yticks=range(0, 101, 20))  # below 0 is room for the legend
    axes.legend(loc="lower right", fontsize=7.0)
    _scales(axes, across)
    axes.grid(True)


def _curves(result: StabilityMap, across: _PictureAxis) -> Figure:
    figure, axes = style.panels(4, 1, height=1.7)
    unit, name = _unit(result)
    flat = {measure: result.grid(measure).ravel() for measure in ("settled", "error", "swing", "settling", "effort")}
    axes[0, 0].plot(across.values, 100.0 * flat["settled"], ".-", color=style.BLUE)
    axes[0, 0].set_ylabel("runs that\nsettle (%)")
    axes[1, 0].plot(across.values, flat["error"] / unit, ".-", color=style.BLUE, label="error")
    axes[1, 0].plot(across.values, flat["swing"] / unit, ".-", color=style.RED, label="swing")
    axes[1, 0].set_ylabel(f"worst, at the\nend ({name})")
    style.legend(axes[1, 0])
    axes[2, 0].plot(across.values, np.where(np.isfinite(flat["settling"]), flat["settling"], np.nan), ".-")
    axes[2, 0].set_ylabel("worst 5 %\nsettling (s)")
    axes[3, 0].plot(across.values, flat["effort"], ".-", color=style.BLUE)
    axes[3, 0].set(ylabel=f"command\n({command_unit(result.settings.servo)} rms)", xlabel=across.label)
    if across.logarithmic:
        axes[3, 0].set_xscale("log")
    style.label_panels(axes[:, 0].tolist())
    return figure


def _sheet(result: StabilityMap, varying: Sequence[_PictureAxis]) -> Figure:
    """The share that settles, over the two longest axes, once for each value of the others."""
    longest = sorted(varying, key=lambda line: -line.values.size)[:2]
    across, up = _order(longest)
    others = [line for line in varying if line.name not in (across.name, up.name)]
    names = [name for name, values in result.axes if len(values) > 1]
    settled = np.moveaxis(
        result.grid("settled").squeeze(), [names.index(line.name) for line in (*others, up, across)], range(len(names))
    )
    columns = others[-1].values.size
    rows = math.prod(line.values.size for line in others[:-1])
    if rows == 1:  # one row of many panels is cut
        rows = -(-columns // 4)
        columns = min(columns, 4)
    figure = style.sheet(max(4.0, 2.0 * columns + 1.2), 2.0 * rows + 0.8)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    places = product(*(range(line.values.size) for line in others))
    for one, place in zip(axes.ravel(), places, strict=False):
        image = one.pcolormesh(across.values, up.values, settled[place], vmin=0.0, vmax=1.0, shading="nearest")
        words = (f"{line.label} = {line.values[i]:.3g}" for line, i in zip(others, place, strict=True))
        one.set_title("\n".join(words), fontsize=7.5)
        _scales(one, across, up)
    for one in axes.ravel()[math.prod(line.values.size for line in others) :]:
        one.set_visible(False)
    figure.supxlabel(across.label, fontsize=9.0)
    figure.supylabel(up.label, fontsize=9.0)
    figure.colorbar(image, ax=axes, label="share of the runs that settle")
    return figure
