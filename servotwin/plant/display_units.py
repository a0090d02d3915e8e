"""Units in which people see the position of a machine: millimetres, or degrees of a rotary axis."""

from __future__ import annotations

import math
from typing import NamedTuple

from servotwin.plant.axis import Axis
from servotwin.plant.load import ROTARY
from servotwin.plant.plants import Plant


class DisplayUnit(NamedTuple):
    """A unit of position for tables and plots.

    Attributes
    ----------
    name : str
        At the end of a key too.
    factor : float
        Number in this unit per metre, or per radian.
    si : str
        The unit inside: m or rad.
    """

    name: str
    factor: float
    si: str

    @property
    def small(self) -> DisplayUnit:
        """The thousandth of this unit, for what is small beside a step."""
        return DisplayUnit("um" if self.name == "mm" else f"m{self.name}", 1e3 * self.factor, self.si)

    def text(self, value: float, form: str = ".1f") -> str:
        """A value in m or rad, with the unit."""
        return f"{value * self.factor:{form}} {self.name}"

    def si_of(self, value: float) -> float:
        """The value in m or rad."""
        return value / self.factor


MILLIMETRES = DisplayUnit("mm", 1e3, "m")
DEGREES = DisplayUnit("deg", 180.0 / math.pi, "rad")


def position_unit(plant: Plant) -> DisplayUnit:
    """Unit of a plant's position."""
    return DEGREES if isinstance(plant, Axis) and plant.load.motion == ROTARY else MILLIMETRES


def gap_in_words(plant: Plant, gap: float, form: str = ".6g") -> str:
    """A gap (rad), in degrees at the motor and as the travel of the load that it is."""
    travel = position_unit(plant).small.text(plant.p * gap, ".3g")
    return f"{math.degrees(gap):{form}} deg at the motor ({travel} at the load)"


def command_unit(plant: Plant) -> str:
    """Unit of the command of a plant's actuator."""
    return plant.actuator.unit if isinstance(plant, Axis) else "V"
