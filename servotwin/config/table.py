"""Strict reader of TOML tables: every value is read by name, type and range; an unknown key is an error.

Each error is one `InvalidInput` sentence that names the file, the key, the value and what is allowed.
"""

from __future__ import annotations

import difflib
import math
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

from servotwin.config.named_file import check_named
from servotwin.config.own_units import AT_LOAD, OwnUnits
from servotwin.config.range import Range
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput

_Default = TypeVar("_Default")
_Value = TypeVar("_Value")


class _Required:
    """The default of a key that must be present."""


REQUIRED = _Required()

_LARGEST, _LONGEST_S, _LARGEST_INTEGER = 1e30, 1e9, 10**15
"""Largest sizes of a number, of a time in seconds (30 years) and of an integer: products of larger ones overflow."""
_LONGEST_TEXT = 1000
_BEGIN, _END = "# complete with the line: # end", "# end"
"""First and last line of a file of which a half must not be read."""


@dataclass
class Table:
    """One TOML table, read key by key.

    Parameters
    ----------
    source : str
        The file, as it is named in messages.
    values : mapping
        The parsed table.
    name : str
        Dotted path of the table inside its file; empty at the top.
    units : OwnUnits, optional
        Units in which the file counts commands and positions, this table's and those within it; None: keys are named
        as they are declared.
    ratio : float, optional
        The load's travel (m or rad) per angle of the motor, of gaps that count at the load; None: the machine is not
        known, and they must count at the motor.
    """

    source: str
    values: Mapping[str, object]
    name: str = ""
    units: OwnUnits | None = None
    ratio: float | None = None
    _known: set[str] = field(default_factory=set)

    def in_units(self, units: OwnUnits | None, ratio: float | None = None) -> Table:
        """The same table, whose keys are named in other units; what one of the two has read the other has too."""
        return Table(self.source, self.values, self.name, units, ratio, self._known)

    def names(self, declared: Sequence[str]) -> tuple[str, ...]:
        """Names that the file may have for the keys that set one attribute.

        Raises
        ------
        InvalidInput
            The file names one of them in a unit that is not the machine's.
        """
        if self.units is None:
            return tuple(declared)
        own = self.units.keys(declared)
        for name in declared:
            if name in self.values and name not in own:
                alike = [each for each in own if (AT_LOAD in each) == (AT_LOAD in name)] or own
                right = self.units.key(name) if self.units.key(name) in own else alike[0]
                raise InvalidInput(
                    f"{self.source}: unknown key '{self.path(name)}': this machine counts it in {unit_of(right).si}; "
                    f"here its name is '{self.path(right)}'"
                )
        return own

    def number(
        self,
        key: str,
        default: _Default | _Required = REQUIRED,
        *,
        minimum: float = -math.inf,
        maximum: float = math.inf,
        positive: bool = False,
        infinite: bool = False,
    ) -> float | _Default:
        """One number (an integer counts); NaN never, inf only where `infinite`."""
        if self._missing(key, default):
            return cast(_Default, default)
        return self.number_in(key, Range(minimum, maximum, 0.0 if positive else -math.inf, infinite=infinite))

    def number_in(self, key: str, allowed: Range) -> float:
        """Value of a present key, a number within a range."""
        return self._number(key, self.values[key], allowed)

    def numbers(
        self,
        key: str,
        default: _Default | _Required = REQUIRED,
        *,
        minimum: float = -math.inf,
        maximum: float = math.inf,
        positive: bool = False,
    ) -> float | tuple[float, ...] | _Default:
        """One number, or a list of at least one."""
        if self._missing(key, default):
            return cast(_Default, default)
        return self.numbers_in(key, Range(minimum, maximum, 0.0 if positive else -math.inf))

    def numbers_in(self, key: str, allowed: Range) -> float | tuple[float, ...]:
        """Value of a present key, a number or a list of at least one, each within a range."""
        value = self.values[key]
        if not isinstance(value, list):
            return self._number(key, value, allowed, " or a list of such")
        if not value:
            raise self.invalid(key, f"{allowed} or a list of such")
        return tuple(self._number(f"{key}[{i}]", item, allowed) for i, item in enumerate(value))

    def integer(
        self,
        key: str,
        default: _Default | _Required = REQUIRED,
        *,
        minimum: float = -math.inf,
        maximum: float = math.inf,
    ) -> int | _Default:
        """One integer within the range."""
        if self._missing(key, default):
            return cast(_Default, default)
        return self.integer_in(key, Range(minimum, maximum))

    def integer_in(self, key: str, allowed: Range) -> int:
        """Value of a present key, an integer within a range."""
        value = self.values[key]
        if isinstance(value, bool) or not isinstance(value, int) or not allowed.accepts(value):
            raise self.invalid(key, allowed.whole)
        if abs(value) > _LARGEST_INTEGER:
            raise self.invalid(key, f"{allowed.whole}, of at most {_LARGEST_INTEGER:g} in size")
        return value

    def text(
        self, key: str, default: _Default | _Required = REQUIRED, *, choices: Sequence[str] | None = None
    ) -> str | _Default:
        """One string, one of `choices` where they are given."""
        if self._missing(key, default):
            return cast(_Default, default)
        value = self.values[key]
        if not isinstance(value, str):
            raise self.invalid(key, "a text in quotes")
        if len(value) > _LONGEST_TEXT or not value.isprintable():
            raise self.invalid(key, f"a text of at most {_LONGEST_TEXT} characters, without line breaks and the like")
        if choices is not None and value not in choices:
            raise self.invalid(key, f"one of {_listed(choices)}{did_you_mean(value, choices)}")
        return value

    def boolean(self, key: str, default: _Default | _Required = REQUIRED) -> bool | _Default:
        """true or false."""
        if self._missing(key, default):
            return cast(_Default, default)
        value = self.values[key]
        if not isinstance(value, bool):
            raise self.invalid(key, "true or false")
        return value

    def table(self, key: str, *, required: bool = False) -> Table:
        """The table [key]; where it is absent and not required, an empty one."""
        self._known.add(key)
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.invalid(key, f"a table [{self.path(key)}]")
        if required and key not in self.values:
            raise self.missing(key, table=True)
        return Table(self.source, value, self.path(key), self.units, self.ratio)

    def tables(self, key: str) -> list[Table]:
        """The array of tables [[key]]; empty where it is absent."""
        self._known.add(key)
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.invalid(key, f"an array of tables [[{self.path(key)}]]")
        paths = [f"{self.path(key)}[{i}]" for i in range(len(value))]
        inner = zip(value, paths, strict=True)
        return [Table(self.source, item, path, self.units, self.ratio) for item, path in inner]

    def known(self, *keys: str) -> None:
        """Allow keys in this table, whether they are read or not."""
        self._known.update(keys)

    def done(self) -> None:
        """Refuse keys that were neither read nor declared known; raises InvalidInput."""
        for key in self.values:
            if key not in self._known:
                allowed = _listed(sorted(self._known)) or "no key at all"
                hint = did_you_mean(key, self._known)
                where = f"table [{self.name}]" if self.name else "the top level"
                raise InvalidInput(f"{self.source}: unknown key '{self.path(key)}'{hint}; {where} allows {allowed}")

    def path(self, key: str) -> str:
        """The key's dotted path inside its file."""
        return f"{self.name}.{key}" if self.name else key

    def missing(self, key: str, *others: str, table: bool = False) -> InvalidInput:
        """The error for a key (or one of others in its place) or a table that must be there; to be raised by the
        caller."""
        alike = "".join(f" or '{self.path(other)}'" for other in others)
        what = f"table [{self.path(key)}]" if table else f"key '{self.path(key)}'{alike}"
        return InvalidInput(f"{self.source}: {what} is missing{self._misspelt(key)}")

    def invalid(self, key: str, allowed: str) -> InvalidInput:
        """The error for a value of `key` that is not allowed; to be raised by the caller."""
        shown = _shown(self.values.get(key))
        return InvalidInput(f"{self.source}: {self.path(key)} = {shown} is not allowed; give {allowed}")

    def _number(self, key: str, value: object, allowed: Range, alternative: str = "") -> float:
        number = _as_float(value)
        if not allowed.accepts(number):
            shown = _shown(value)
            raise InvalidInput(f"{self.source}: {self.path(key)} = {shown} is not allowed; give {allowed}{alternative}")
        largest = _LONGEST_S if unit_of(key).si == "s" else _LARGEST
        if largest < abs(number) < math.inf:
            raise self.invalid(key, f"{allowed}, of at most {largest:g} in size")
        return number

    def _missing(self, key: str, default: object) -> bool:
        self._known.add(key)
        if key in self.values:
            return False
        if default is REQUIRED:
            raise self.missing(key)
        return True

    def _misspelt(self, key: str) -> str:
        # Units are as long as names: another quantity in the same unit is no misspelling.
        word = key.partition("_")[0]
        alike = [
            other
            for other in self.values
            if other not in self._known and difflib.get_close_matches(word, [other.partition("_")[0]])
        ]
        close = difflib.get_close_matches(key, alike, n=1)
        return f" (found '{self.path(close[0])}' instead)" if close else ""


@contextmanager
def named(table: Table) -> Iterator[None]:
    """Prefix an InvalidInput that a constructor raises with the file and the table."""
    try:
        yield
    except InvalidInput as error:
        if str(error).startswith(table.source):
            raise
        where = f"{table.source}: [{table.name}]" if table.name else table.source
        raise InvalidInput(f"{where}: {error}") from None


@contextmanager
def of_key(table: Table, key: str) -> Iterator[None]:
    """Prefix an InvalidInput about a value with file, key and value; of a file that cannot be read, raise one."""
    try:
        yield
    except InvalidInput as error:
        if str(error).startswith(f"{table.source}: {table.path(key)}"):
            raise
        raise InvalidInput(f"{table.source}: {table.path(key)} = {_shown(table.values[key])}: {error}") from None
    except OSError as error:
        raise table.invalid(key, f"a file that can be read ({error.strerror or error})") from None


def read_inner(table: Table, key: str, read: Callable[[Table], _Value]) -> _Value:
    """Read an inner table with `read`; every key must be read."""
    inner = table.table(key)
    with named(inner):
        value = read(inner)
    inner.done()
    return value


def read_toml(path: str | os.PathLike[str]) -> Table:
    """Read a TOML file as a strict `Table`.

    Raises
    ------
    InvalidInput
        The file is missing, unreadable, not UTF-8, not TOML, or empty.
    """
    source = os.fspath(path)
    check_named(path)
    try:
        text = Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise InvalidInput(f"{source}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise InvalidInput(f"{source}: is not a TOML file (byte {error.start} is not UTF-8)") from None
    return parse_toml(text, source)


def parse_toml(text: str, source: str) -> Table:
    """Read TOML text as a strict `Table`; `source` is its name in messages."""
    try:
        values: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InvalidInput(f"{source}: is not a TOML file ({error})") from None
    if not values:
        raise InvalidInput(f"{source}: is empty; it must hold at least one key")
    return Table(source, values)


def with_end(text: str) -> str:
    """Put the text of a written file between the two lines by which `check_complete` finds that it was cut short."""
    return f"{_BEGIN}\n{text}{_END}\n"


def check_complete(path: Path, remedy: str) -> None:
    """Check that a file which `with_end` made is whole; one without its first line may be any.

    Half of a file can often be read, and would leave out what protects the machine, or who has a token.

    Raises
    ------
    InvalidInput
        It was cut short; the sentence ends with the remedy. Or it is no file.
    """
    check_named(path)
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return  # whoever reads it as TOML says why
    if _BEGIN in lines and _END not in lines:
        raise InvalidInput(f"{path}: is cut short: its line {_END!r} is missing; {remedy}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint such as " (did you mean 'mass_kg'?)", or nothing where no known word is close."""
    words = sorted(known)
    close = [name for name in words if name.lower() == word.lower()]
    # The same quantity in another unit.
    close += [name for name in words if "_" in word and name.rpartition("_")[0] == word.rpartition("_")[0]]
    close += difflib.get_close_matches(word, words, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _as_float(value: object) -> float:
    """The number as a float; NaN where it is none, or too large for one."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
