"""A finished map: its measures on the grid, and its files of numbers."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servotwin.analysis.maps.axes import RatioAxes, Values, axis_names, axis_values
from servotwin.analysis.maps.measures import MEASURES, Measures
from servotwin.analysis.maps.settings import MapSettings
from servotwin.hybrid.automaton import Array
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.runtime import files

_ANGLES = ("gap", "estimate")
_LENGTHS = ("error", "swing", "amplitude")


@dataclass(frozen=True, eq=False)
class StabilityMap:
    """A finished map: its settings and the measures of its cells."""

    settings: MapSettings
    measures: Measures

    def grid(self, name: str) -> Array:
        """A measure, shaped as the axes."""
        values: Array = getattr(self.measures, name)
        return values.reshape(self.settings.axes.shape)

    @property
    def slow(self) -> NDArray[np.bool_]:
        """Cells in which ten seconds call more members settled than the final window does."""
        return self.grid("settled_short") > self.grid("settled")

    @property
    def axes(self) -> tuple[tuple[str, Values], ...]:
        """Every axis: its name and its values."""
        axes = self.settings.axes
        return tuple((name, axis_values(axes, name)) for name in axis_names(axes))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the axes and of the measures, with units: m or rad, and that of the command."""
        servo = self.settings.servo
        command = command_unit(servo).lower().replace("/", "_per_").replace(" ", "_")
        units = dict.fromkeys(_ANGLES, "_rad") | dict.fromkeys(_LENGTHS, f"_{position_unit(servo).si}")
        units |= {"settling": "_s", "effort": f"_{command}"}
        if isinstance(self.settings.axes, RatioAxes):
            axes = ["tolerance_per_pb", "amplitude_per_pb"]
        else:
            axes = [name + units.get(name, "") for name, _ in self.axes]
        return (*axes, *(name + units.get(name, "") for name in MEASURES))


def write_numbers(stability: StabilityMap, directory: Path) -> None:
    """Write map.npz, the axes and the measures on the grid, and map.csv, one line per cell."""
    names, count = stability.columns, len(stability.axes)
    arrays = {name: np.array(values) for name, (_, values) in zip(names, stability.axes, strict=False)}
    arrays |= {name: stability.grid(measure) for name, measure in zip(names[count:], MEASURES, strict=True)}
    with files.atomic_output(directory / "map.npz") as temporary:
        np.savez(temporary, allow_pickle=False, fingerprint=np.array(stability.settings.fingerprint), **arrays)
    with (
        files.atomic_output(directory / "map.csv") as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        csv.writer(file).writerows([names, *_lines(stability)])


def _lines(stability: StabilityMap) -> Iterator[list[str]]:
    cells = product(*(values for _, values in stability.axes))
    measures = zip(*(getattr(stability.measures, name).tolist() for name in MEASURES), strict=True)
    for cell, row in zip(cells, measures, strict=True):
        yield [repr(value) for value in (*cell, *row)]
