"""Names of keys in the units of a machine: a declaration names those of a voltage and a position in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from servotwin.config.units import suffix_of, unit_of

COMMANDS = {"V": ("v", "voltage"), "N m": ("n_m", "torque"), "rad/s": ("rad_per_s", "speed"), "rad": ("rad", "angle")}
"""Units of a command: the end of a key, and the word for its quantity."""
POSITIONS: Mapping[str, Mapping[str, str]] = {"m": {}, "rad": {"m": "rad", "mm": "deg", "um": "mdeg"}}
"""Units of a position: ends of keys by those of a position in metres, where they are others."""
AT_LOAD = "_at_load_"
"""Before the unit, in keys of gaps that count at the load: elsewhere they count at the motor."""
_TRAVELS = ("um", "mm", "mdeg", "deg", "arcmin")


def at_load(name: str) -> tuple[str, ...]:
    """Keys of a gap as the travel of the load, linear or rotary, beside its key at the motor."""
    stem = name.removesuffix(f"_{suffix_of(name)}")
    return tuple(f"{stem}{AT_LOAD}{unit}" for unit in _TRAVELS)


@dataclass(frozen=True, slots=True)
class OwnUnits:
    """Units of a machine's command and position.

    Parameters
    ----------
    command : str
        One of `COMMANDS`.
    position : str
        One of `POSITIONS`.
    """

    command: str = "V"
    position: str = "m"

    def key(self, name: str) -> str:
        """Name here of a key that is declared for a voltage and a position in metres."""
        return _own(self, name)

    def keys(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names here of the keys that set one attribute, the same for all that it may be called otherwise.

        Of keys that are declared in several units of commands or positions only those in the machine's own count. A
        gap is an angle at the motor of every machine, and at the load a position.
        """
        loads = [name for name in names if AT_LOAD in name]
        if loads and len(loads) < len(names):
            return (*self.keys([name for name in names if name not in loads]), *self.keys(loads))
        kinds = {unit_of(name).si for name in names}
        for own, alike in ((self.position, POSITIONS), (self.command, COMMANDS)):
            if len(kinds) > 1 and kinds <= alike.keys():
                return tuple(name for name in names if unit_of(name).si == own)
        return tuple(dict.fromkeys(map(self.key, names)))

    def named(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values of a table and of those within it, that have the exact keys of a declaration, by their names here."""
        return {self.key(name): self.named(v) if isinstance(v, Mapping) else v for name, v in values.items()}


VOLTS_METRES = OwnUnits()
"""Those of a declaration."""


@cache
def _own(units: OwnUnits, name: str) -> str:
    suffix = suffix_of(name)
    words = suffix.split("_")
    if words[0] in _OTHERS:
        return name
    command, quantity = COMMANDS[units.command]
    shown = {**POSITIONS[units.position], "v": command, "mv": f"m{command}"}
    stem = name.removesuffix(suffix)
    stem = stem.replace("voltage", quantity) if {"v", "mv"} & set(words) else stem
    return stem + "_".join(shown.get(word, word) for word in words)


# First words of units in which m is no position: newtons and kilograms, times metres or per metre.
_OTHERS = ("n", "kg")
