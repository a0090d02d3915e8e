"""Options that state a gap: at the motor in degrees or, in its place, at the load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from servotwin.cli.own_options import option_of
from servotwin.config.own_units import AT_LOAD
from servotwin.config.own_units import at_load as at_load_keys
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant

_Value = TypeVar("_Value", str, float)


@dataclass(frozen=True)
class GapForm:
    """The form in which a gap is stated.

    Parameters
    ----------
    key : str
        Ends with the unit; with `AT_LOAD` in it the gap counts at the load.
    ratio : float
        rad at the motor per m or rad of the key's place.
    """

    key: str
    ratio: float = 1.0

    @property
    def option(self) -> str:
        """Its option."""
        return option_of(self.key)

    @property
    def unit(self) -> str:
        """Its unit, and the place."""
        return unit_of(self.key).name + (" at the load" if AT_LOAD in self.key else "")

    def at_motor(self, value: float) -> float:
        """The gap at the motor, rad."""
        return unit_of(self.key).to_si(value) * self.ratio

    def shown(self, gap: float) -> float:
        """The value of a gap at the motor (rad) in this form."""
        return unit_of(self.key).from_si(gap / self.ratio)


def stated_gap(
    name: str, degrees: _Value | None, at_load: Mapping[str, _Value], machine: str, plant: Plant
) -> tuple[GapForm, _Value | None]:
    """The form in which options state a gap, and its value; degrees at the motor, and None, where none of them does.

    Parameters
    ----------
    name : str
        Of the gap: its keys begin with it.
    degrees : str or float, optional
        At the motor.
    at_load : mapping
        Values that were given at the load, by key; also of other gaps.
    machine : str
        Its name, for messages.
    plant : Servo or Axis

    Raises
    ------
    InvalidInput
        Two options state the gap, or one in a unit that the load does not have.
    """
    usual: str = f"{name}_deg"
    stated = [(key, value) for key, value in at_load.items() if key.startswith(name + AT_LOAD)]
    if degrees is not None:
        stated.insert(0, (usual, degrees))
    if not stated:
        return GapForm(usual), None
    shown = [f"{option_of(key)} {value if isinstance(value, str) else f'{value:g}'}" for key, value in stated]
    if len(stated) > 1:
        raise InvalidInput(f"{' and '.join(shown)}: a gap is stated once; give only one of them")
    [(key, value)] = stated
    own = own_units(plant).keys((usual, *at_load_keys(usual)))
    if key not in own:
        right = next(each for each in own if AT_LOAD in each)
        raise InvalidInput(f"{shown[0]}: the load of {machine} counts in {unit_of(right).si}; give {option_of(right)}")
    return GapForm(key, 1.0 / plant.p if AT_LOAD in key else 1.0), value
