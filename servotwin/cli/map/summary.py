"""A stability map in words and as a table along its first axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from servotwin.analysis.maps.axes import RatioAxes
from servotwin.analysis.maps.result import StabilityMap
from servotwin.hybrid.automaton import Array
from servotwin.plant.display_units import command_unit, position_unit

ROWS = 21
_LABELS = {
    "gap": ("gap\ndeg", math.degrees(1.0)),
    "estimate": ("estimate\ndeg", math.degrees(1.0)),
    "k_dz": ("k_DZ", 1.0),
}
_RATIO_LABELS = {"tolerance": ("tolerance\n/(p b)", 1.0), "amplitude": ("step\n/(p b)", 1.0)}


def label(result: StabilityMap, name: str) -> tuple[str, float]:
    """An axis's name with its unit, and what its values are multiplied by to be in it."""
    if isinstance(result.settings.axes, RatioAxes):
        return _RATIO_LABELS[name]
    unit = position_unit(result.settings.servo)
    return (_LABELS | {"amplitude": (f"step\n{unit.name}", unit.factor)})[name]


def heads(result: StabilityMap) -> tuple[str, ...]:
    """Heads of the table's columns of measures, in the units of the servo."""
    unit, command = position_unit(result.settings.servo).name, command_unit(result.settings.servo)
    shares = "all settle\n% of cells", "settled\n% of runs"
    return (*shares, f"error\n{unit}", f"swing\n{unit}", "settling\ns", f"effort\n{command} rms")


def _table_axis(result: StabilityMap) -> int:
    """Index of the axis along which the table runs: the dead zone where it varies, else the first axis that varies."""
    varying = [i for i, (_, values) in enumerate(result.axes) if len(values) > 1]
    dead_zone = [i for i in varying if result.axes[i][0] in ("tolerance", "k_dz")]
    return (dead_zone or varying or [0])[0]


def rows(result: StabilityMap) -> list[tuple[float, Array]]:
    """One row per value of the table's axis, `ROWS` at most: the value, and the numbers in the order of `heads`.

    Error, swing and settling time are the worst of the cells; shares and effort are means.
    """
    axis = _table_axis(result)
    name, values = result.axes[axis]
    scale = label(result, name)[1]
    chosen = np.unique(np.linspace(0, len(values) - 1, min(ROWS, len(values))).round().astype(int))
    return [(values[i] * scale, _numbers(result, axis, int(i))) for i in chosen]


def _numbers(result: StabilityMap, axis: int, place: int) -> Array:
    cells = {name: result.grid(name).take(place, axis) for name in ("settled", "error", "swing", "settling", "effort")}
    shares = 100.0 * np.mean(cells["settled"] == 1.0), 100.0 * np.mean(cells["settled"])
    factor = position_unit(result.settings.servo).factor
    worst = factor * cells["error"].max(), factor * cells["swing"].max(), cells["settling"].max()
    return np.array([*shares, *worst, np.sqrt(np.mean(cells["effort"] ** 2))])


def sentences(result: StabilityMap) -> tuple[str, ...]:
    """Runs, definition of settled, and the shares over the whole map."""
    s, settled = result.settings, result.grid("settled")
    unit = position_unit(s.servo).small
    slow = int(result.slow.sum())
    return (
        f"{s.count} cells with {s.members} initial states each, {s.run_time:g} s a run;"
        f" settled: half the peak-to-peak of the last {s.last_part:g} s"
        f" below {unit.factor * s.stillness:g} {unit.name}{_scale(result)}.",
        f"Every run settles in {_percent(settled == 1.0)} of the cells, none in {_percent(settled == 0.0)};"
        f" {_percent(settled)} of all runs settle.",
        *(
            [f"In {slow} cells more runs rest in the last {s.short_part:g} s alone: they rest, then move on."]
            if slow
            else []
        ),
        "In the table error, swing (half the peak-to-peak) and settling are the worst of all runs.",
    )


def _percent(values: Array) -> str:
    return f"{100.0 * float(np.mean(values)):.1f} %"


def _scale(result: StabilityMap) -> str:
    axes, law, servo = result.settings.axes, result.settings.law, result.settings.servo
    if not isinstance(axes, RatioAxes):
        return ""
    at = f" at a gap of {math.degrees(axes.gap):g} deg"
    # None of these scales with the gap.
    limits = law.voltage_limit is not None or servo.command_limit is not None
    if limits or law.feedforward or servo.motor_friction or servo.guide.friction or servo.guide.force:
        return f"{at}; the map holds for this gap only"
    return f"{at} ({result.settings.stillness / (0.5 * result.settings.servo.p * axes.gap):.3g} p b for any gap)"


def text(result: StabilityMap) -> str:
    """Sentences and table as plain text."""
    console = Console(width=110, no_color=True, record=True, quiet=True, file=None)
    with console.capture() as captured:
        console.quiet = False
        print_summary(result, console)
    return "\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n"


def print_summary(result: StabilityMap, console: Console) -> None:
    """Print sentences and table."""
    for sentence in sentences(result):
        console.print(sentence, highlight=False)
    table = Table(label(result, result.axes[_table_axis(result)][0])[0], *heads(result), box=None, pad_edge=False)
    for value, numbers in rows(result):
        table.add_row(f"{value:.4g}", *_cells(numbers.tolist()))
    console.print(table, highlight=False)


def _cells(numbers: Sequence[float]) -> list[str]:
    shares = [f"{share:.1f}" for share in numbers[:2]]
    settling = "never" if math.isinf(numbers[4]) else f"{numbers[4]:.1f}"
    return [*shares, f"{numbers[2]:.4f}", f"{numbers[3]:.4f}", settling, f"{numbers[5]:.3f}"]
