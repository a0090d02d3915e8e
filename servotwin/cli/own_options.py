"""Options in the units of a machine: of those that state the same in several units one fits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import typer

from servotwin.config.own_units import AT_LOAD, OwnUnits
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput

_Value = TypeVar("_Value", str, float)
_TRAVELS = ("um", "mdeg", "arcmin")
UM, MDEG, ARCMIN = (typer.Option(help=f"The same at the load, {unit}.", show_default=False) for unit in _TRAVELS)
"""The options NAME-at-load-UNIT of a gap, beside NAME-deg."""


def travels(name: str, *values: _Value | None) -> dict[str, _Value]:
    """Those that were given of the values of `UM`, `MDEG` and `ARCMIN` of a gap, by key."""
    pairs = zip(_TRAVELS, values, strict=True)
    return {f"{name}{AT_LOAD}{unit}": value for unit, value in pairs if value is not None}


def option_of(key: str) -> str:
    """The option that a key's value comes from."""
    return f"--{key.replace('_', '-')}"


def own_option(given: Mapping[str, _Value | None], usual: str, machine: str, units: OwnUnits) -> _Value | None:
    """Value of the one option, of several in different units, that a machine has; None: it was not given.

    Parameters
    ----------
    given : mapping
        Values by key, such as `step_mm` and `step_deg`; None: not given.
    usual : str
        Key of a machine that commands a voltage and counts its position in metres.
    machine : str
        Its name, for messages.
    units : OwnUnits

    Raises
    ------
    InvalidInput
        One was given that the machine does not have.
    """
    own = units.key(usual)
    for key, value in given.items():
        if value is not None and key != own:
            shown = value if isinstance(value, str) else f"{value:g}"
            raise InvalidInput(
                f"{option_of(key)} {shown}: {machine} has it in {unit_of(own).name}; give {option_of(own)}"
            )
    return given.get(own)
