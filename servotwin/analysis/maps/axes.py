"""The axes of a stability map, and the loop that each of its cells stands for."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeAlias

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.plants import Plant
from servotwin.plant.signals import check_gap

Values: TypeAlias = tuple[float, ...]
MAX_CELLS = 1_000_000


class Cells(NamedTuple):
    """(N,) total gap (rad), dead-zone half-width (m) and reference step (m) of every cell, last axis fastest."""

    gap: Array
    tolerance: Array
    amplitude: Array


@dataclass(frozen=True)
class RatioAxes:
    """Tolerance and reference step in units of p b (half the gap at the screw), the only ratios that matter.

    The loop is homogeneous of degree one, so that a map over these two serves every gap; it is computed at one.

    Parameters
    ----------
    tolerance : tuple of float
        tolerance/(p b), 0 or more; k_DZ of Eq 21 is half of it when the gap is known exactly.
    amplitude : tuple of float
        step/(p b), greater than 0.
    gap : float
        rad, total; sets the scale of every result in metres and volts.

    Raises
    ------
    InvalidInput
        An axis is empty or has a value outside its range.
    """

    tolerance: Values
    amplitude: Values
    gap: float = math.radians(10.0)

    def __post_init__(self) -> None:
        _check("tolerance", self.tolerance, "p b", positive=False)
        _check("amplitude", self.amplitude, "p b", positive=True)
        _check("gap", (self.gap,), "rad", positive=True)
        _check_size(self)

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each axis."""
        return len(self.tolerance), len(self.amplitude)

    def check_gap(self, servo: Plant) -> None:
        """Refuse a gap that is larger than that of a machine can be."""
        check_gap(self.gap, largest=servo.largest_gap)

    def cells(self, servo: Plant) -> Cells:
        """Every cell in SI units."""
        unit = 0.5 * servo.p * self.gap
        tolerance, amplitude = _grid(self.tolerance, self.amplitude)
        return Cells(np.full(tolerance.size, self.gap), unit * tolerance, unit * amplitude)


@dataclass(frozen=True)
class PhysicalAxes:
    """Gap, its estimate, k_DZ and reference step.

    Parameters
    ----------
    gap : tuple of float
        rad, total, 0 or more.
    k_dz : tuple of float
        Tolerances per estimated gap (Eq 21), 0 or more.
    amplitude : tuple of float
        m, reference step, greater than 0.
    estimate : tuple of float
        rad, estimate of the total gap, for which the dead zone is set; empty: the true gap.

    Raises
    ------
    InvalidInput
        An axis is empty or has a value outside its range.
    """

    gap: Values
    k_dz: Values = (1.0,)
    amplitude: Values = (1e-3,)
    estimate: Values = ()

    def __post_init__(self) -> None:
        _check("gap", self.gap, "rad", positive=False)
        if self.estimate:
            _check("estimate", self.estimate, "rad", positive=False)
        _check("k_dz", self.k_dz, "tolerances per gap", positive=False)
        _check("amplitude", self.amplitude, "m", positive=True)
        _check_size(self)

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each axis: gap, estimate, k_dz, amplitude."""
        return len(self.gap), max(1, len(self.estimate)), len(self.k_dz), len(self.amplitude)

    def check_gap(self, servo: Plant) -> None:
        """Refuse gaps and estimates that are larger than those of a machine can be."""
        check_gap(max(self.gap), largest=servo.largest_gap)
        check_gap(max(self.estimate, default=0.0), "estimate", servo.largest_gap)

    def cells(self, servo: Plant) -> Cells:
        """Every cell in SI units."""
        gap, estimate, k_dz, amplitude = _grid(self.gap, self.estimate or (math.nan,), self.k_dz, self.amplitude)
        estimate = estimate if self.estimate else gap
        return Cells(gap, k_dz * servo.p * estimate, amplitude)


Axes: TypeAlias = RatioAxes | PhysicalAxes


def axis_names(axes: Axes) -> tuple[str, ...]:
    """The axes' names in the order of `shape`."""
    return ("tolerance", "amplitude") if isinstance(axes, RatioAxes) else ("gap", "estimate", "k_dz", "amplitude")


def axis_values(axes: Axes, name: str) -> Values:
    """The values along an axis; NaN for an estimate that is always the truth."""
    values: Values = getattr(axes, name)
    return values or (math.nan,)


def as_lists(axes: Axes) -> dict[str, object]:
    """The axes as plain lists of numbers."""
    return {field.name: np.array(getattr(axes, field.name)).tolist() for field in fields(axes)}


def _grid(*axes: Values) -> list[Array]:
    return [grid.ravel() for grid in np.meshgrid(*map(np.array, axes), indexing="ij")]


def _check(name: str, values: Values, unit: str, *, positive: bool) -> None:
    if not values:
        raise InvalidInput(f"map axis {name}: is empty; give at least one value in {unit}")
    for value in values:
        if not (math.isfinite(value) and (value > 0.0 if positive else value >= 0.0)):
            allowed = "greater than 0" if positive else "0 or more"
            raise InvalidInput(f"map axis {name} = {value!r} {unit}: every value must be finite and {allowed}")
    if len(set(values)) < len(values):
        raise InvalidInput(f"map axis {name}: has a value in {unit} twice; every value must differ")


def _check_size(axes: Axes) -> None:
    if math.prod(axes.shape) > MAX_CELLS:
        sizes = " x ".join(map(str, axes.shape))
        raise InvalidInput(f"map axes: {sizes} cells are too many; a map may have {MAX_CELLS} at most")
