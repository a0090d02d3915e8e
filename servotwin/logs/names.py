"""Names of columns and the units in them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.travel import ANGLES, LENGTHS

# A number in brackets is a row of a matrix.
_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\d\])][^\])]*)[\])]\s*$")
# Longer ones first: the end of _n_m is no metre.
_ENDINGS = ("n_m", "deg", "rad", "mrad", "rev", "mm", "um", "nm", "m", "counts", "s", "ms", "us", "ns", "v", "a", "n")
_BARE = ("theta_m",)  # names that end as a unit does
_ALIASES: Mapping[str, str] = {
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("turn", "turns", "revs", "revolution", "revolutions"), "rev"),
    **dict.fromkeys(("micron", "microns", "\N{GREEK SMALL LETTER MU}m"), "µm"),
    **dict.fromkeys(("inch", "inches", '"'), "in"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
    "\N{GREEK SMALL LETTER MU}s": "µs",
    # In any case of letters; of nm it says metres or newtons.
    **{unit: unit for unit in ("deg", "rad", "mrad", "rev", "mm", "µm", "um", "ms")},
}
_KNOWN = {*ANGLES, *LENGTHS, "s", "sec", "ms", "us", "µs", "ns", "min", "h"}
_PART = re.compile(r"^(?P<unit>\D.*?)\s*/\s*(?P<parts>[-+.\d].*|)$")
_BEHIND_COMMA = re.compile(r"^(?P<name>.*\w)\s*[,/]\s*(?P<unit>[^\s,/\d]+|N m)\s*$")
_COMMANDS = ("V", "A", "N", "N m", "Nm")


def given_column(path: Path, part: str, given: str, names: Sequence[str]) -> str:
    """The column of that name, with its unit or without.

    Raises
    ------
    InvalidInput
        There is none.
    """
    fitting = [name for name in names if given in (name, bare_name(name))]
    within = [name for name in names if given == _last_part(name)]
    if not fitting and len(within) > 1:
        raise InvalidInput(
            f"log {path}: --{part} {given!r}: {len(within)} columns end so: {', '.join(within)}; give one"
        )
    fitting = fitting or within
    if not fitting:
        hint = did_you_mean(given, names)
        raise InvalidInput(f"log {path}: --{part} {given!r}: there is no such column{hint}; it has {', '.join(names)}")
    return fitting[0]


def guessed_column(guesses: Sequence[str], names: Sequence[str]) -> str | None:
    """The column with the first of the guessed names that occurs; the last part of a path counts where it is unique."""
    within: dict[str, list[str]] = {}
    for name in names:
        within.setdefault(_plain(_last_part(name)), []).append(name)
    known = {part: found[0] for part, found in within.items() if len(found) == 1}
    known |= {_plain(bare_name(name)): name for name in reversed(names)}
    return next((known[guess] for guess in guesses if guess in known), None)


def _plain(name: str) -> str:
    return name.lower().replace(" ", "_")


def _last_part(name: str) -> str:
    """Name of a column within its structure or group, without its unit."""
    return bare_name(name).rpartition("/")[2]


def bare_name(name: str) -> str:
    """A column's name without its unit."""
    return _parted(name)[0]


def named_unit(name: str) -> str:
    """The unit that a column's name says; empty where it says none."""
    return known_unit(_parted(name)[1])


def known_unit(unit: str) -> str:
    """A unit as the package writes it: `deg` for `Degrees`, `mm` for `MM`; an unknown one as it is."""
    bare = unit.strip()
    return bare if bare in _KNOWN else _ALIASES.get(bare.lower(), bare)


def divided_unit(path: Path, unit: str) -> tuple[str, float]:
    """A unit and by what it is divided: of `rev/4096`, counts of an encoder with 4096 in a turn, `rev` and 4096.

    Raises
    ------
    InvalidInput
        It is divided by no positive number.
    """
    found = _PART.match(unit)
    if not found:
        return unit, 1.0
    try:
        parts = float(found["parts"])
    except ValueError:
        parts = math.nan
    if not 0.0 < parts < math.inf:
        raise InvalidInput(f"log {path}: unit {unit!r}: must be divided by a number above 0, such as rev/4096")
    return known_unit(found["unit"]), parts


def _parted(name: str) -> tuple[str, str]:
    """Name and unit of a column: `load [mm]`, `load, mm`, `load / mm` or `load_mm`."""
    found = _UNIT.match(name)
    if found:
        return found["name"], found["unit"].strip()
    found = _BEHIND_COMMA.match(name)
    if found and (known_unit(found["unit"]) in _KNOWN or found["unit"] in _COMMANDS):
        return found["name"], found["unit"]
    if name.lower() in _BARE:
        return name, ""
    ending = next((each for each in _ENDINGS if name.lower().endswith(f"_{each}")), "")
    return (name[: -len(ending) - 1], ending) if ending else (name, "")
