"""Conversion of TOML tables to declared settings and back; `config.keys` describes the declaration."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING
from functools import partial
from pathlib import Path
from typing import Any

from servotwin.config.contradiction import Contradiction
from servotwin.config.keys import ORDERED, Form, Item, Maker, items_of
from servotwin.config.own_units import AT_LOAD
from servotwin.config.table import Table, named, of_key
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput

Values = dict[str, Any]


def read(table: Table, maker: Any, folder: Path = Path(), base: Any = None, **given: Any) -> Any:
    """Make settings of a table; the caller ends with `table.done()`, unless the table is an inner one.

    Parameters
    ----------
    table : Table
    maker : class or function
        Declares the keys.
    folder : Path
        Folder that paths in the file are relative to.
    base : object, optional
        Settings of that class, whose values hold where the table gives none. None: the declared defaults.
    given
        Values of further parameters, which are not read from the table.

    Raises
    ------
    InvalidInput
        A key is missing or unknown, or a value is not allowed.
    """
    items = [item for item in items_of(maker) if item.key.in_file and item.name not in given]
    values = {**_read_items(table, items, folder, base, complete=base is None), **given}
    if base is None:
        return made(table, maker, maker, values)
    return made(table, type(base), partial(dataclasses.replace, base), values)


def changes(table: Table, maker: Any, only: Collection[str] | None = None, folder: Path = Path()) -> Values:
    """Read the attributes that a table gives, by name; absent ones are left out.

    Parameters
    ----------
    only : collection of str, optional
        Attributes to read; None: all.
    """
    items = [item for item in items_of(maker) if item.key.in_file and (only is None or item.name in only)]
    return _read_items(table, items, folder, None, complete=False)


def _read_items(table: Table, items: list[Item], folder: Path, base: Any, complete: bool) -> Values:
    """Values by attribute; `complete`: an attribute without default has to be there."""
    values: Values = {}
    for name in dict.fromkeys(item.key.table for item in items):
        here = [item for item in items if item.key.table == name]
        required = complete and any(item.required for item in here)
        inner = table.table(name, required=required) if name else table
        plain = [item for item in here if item.key.prefix is None]
        inner.known(*(key for item in plain for key in (*inner.names(item.names), *_switch(item))))
        for item in here:
            _read_item(inner, item, folder, getattr(base, item.name, None), values)
            if complete and item.required and item.name not in values:
                raise inner.missing(*inner.names(item.names), table=item.form is Form.TABLE)
        if name:
            inner.done()
    return values


def attribute(table: Table, maker: Any, name: str, folder: Path = Path()) -> Any:
    """Read one declared attribute, before the others of its table; the default where the table does not give it.

    Raises
    ------
    InvalidInput
        It is missing and required, or its value is not allowed.
    """
    item = next(each for each in items_of(maker) if each.name == name)
    return _read_items(table, [item], folder, None, complete=True).get(name, item.default)


def part(table: Table, name: str, maker: Any, folder: Path = Path(), base: object = None, **given: Any) -> Any:
    """Make settings of an inner table, which is read to its last key; an absent one gives the defaults."""
    inner = table.table(name)
    made = read(inner, maker, folder, base, **given)
    inner.done()
    return made


def _switch(item: Item) -> tuple[str, ...]:
    return (item.key.switch,) if item.key.switch else ()


def _read_item(table: Table, item: Item, folder: Path, base: object, values: Values) -> None:
    """One attribute, where the table gives it."""
    if item.key.prefix is not None:
        start = base if base is not None else item.default
        values[item.name] = _prefixed(table, item, start)
        return
    if item.key.switch and not table.boolean(item.key.switch, True):
        values[item.name] = None
        return
    if item.key.at_load:
        _check_one_gap(table, item)
    for name in table.names(item.names):
        # A law without states has matrices without numbers.
        if name in table.values and not (item.form is Form.NUMBERS and table.values[name] == []):
            values[item.name] = _value(table, item, name, folder, base)


def _check_one_gap(table: Table, item: Item) -> None:
    """Refuse a gap that is stated twice, or at the load of a machine that is not known."""
    given = [f"{table.path(name)} = {table.values[name]!r}" for name in item.names if name in table.values]
    if len(given) > 1:
        raise InvalidInput(f"{table.source}: {' and '.join(given)}: a gap is stated once; give only one of them")
    if given and item.names[0] not in table.values and table.ratio is None:
        usual = table.path(item.names[0])
        raise InvalidInput(f"{table.source}: {given[0]}: no machine is known here; give {usual}, at its motor")


def _prefixed(table: Table, item: Item, start: Any) -> Any:
    """Settings whose keys begin with a prefix, in the same table."""
    prefix, given = item.key.prefix or "", Values()
    for each in items_of(item.type):
        names = table.names([prefix + name for name in each.names])
        table.known(*names)
        for name in names:
            if name in table.values:
                given[each.name] = _value(table, each, name, Path(), None)
    make = item.type if start is MISSING else partial(dataclasses.replace, start)
    return made(table, item.type, make, given, prefix)


def _value(table: Table, item: Item, name: str, folder: Path, base: object) -> Any:
    """The value of a key that is there, in the attribute's unit."""
    declared = item.key
    if item.form is Form.TABLES:
        return tuple(_of_kind(each, item, folder) for each in table.tables(name))
    if declared.makers is not None:
        return _of_kind(table.table(name), item, folder)
    if item.form is Form.TABLE:
        start = base if isinstance(base, type(item.default)) else item.default
        return part(table, name, item.type, folder, start if dataclasses.is_dataclass(start) else None)
    read_value = _plain(table, item, name, folder)
    if declared.parse is None:
        return read_value
    with of_key(table, name):
        return declared.parse(table, name, read_value, folder)


def _plain(table: Table, item: Item, name: str, folder: Path) -> Any:
    """A number, a text, a truth value, a path or a list."""
    unit, form = unit_of(name), item.form
    if form is Form.BOOLEAN:
        return table.boolean(name)
    if form is Form.TEXT:
        text = table.text(name, choices=item.key.choices)
        return str(folder / text) if item.key.relative else text
    if form is Form.PATH:
        return folder / table.text(name)
    if form is Form.INTEGER and unit.exact:
        return table.integer_in(name, item.key.range)
    to_si, limits = _conversion(table, name), item.key.range.scaled(unit.from_si)
    if form in (Form.PAIR, Form.NUMBERS):
        numbers = table.numbers_in(name, limits)
        if form is Form.PAIR and (not isinstance(numbers, tuple) or len(numbers) != 2):
            raise table.invalid(name, "two numbers")
        if item.key.ordered and isinstance(numbers, tuple) and numbers[0] > numbers[1]:
            raise table.invalid(name, f"two numbers{ORDERED}")
        converted = tuple(map(to_si, numbers)) if isinstance(numbers, tuple) else to_si(numbers)
        return (converted,) if item.type == tuple[float, ...] and not isinstance(converted, tuple) else converted
    if form in (Form.NUMBER, Form.INTEGER):
        number = to_si(table.number_in(name, limits))
        return round(number) if form is Form.INTEGER else number
    return table.values[name]


def _conversion(table: Table, name: str) -> Callable[[float], float]:
    """Conversion of a key's value to the attribute's unit, and of a travel of the load to the angle of the motor."""
    unit, ratio = unit_of(name), table.ratio
    if AT_LOAD not in name or ratio is None:
        return unit.to_si
    return lambda number: unit.to_si(number) / ratio


def _of_kind(table: Table, item: Item, folder: Path) -> Any:
    """A table of several kinds."""
    makers = item.makers
    if item.key.select is not None:
        return _whole(table, item.key.select(table), folder)
    if len(makers) == 1:
        return _whole(table, next(iter(makers.values())), folder)
    return read_kind(table, makers, folder)


def kind_of(table: Table, makers: Mapping[str, Maker], default: str | None = None) -> str:
    """The kind that a table's key `kind` names; `default` where it has none, otherwise the key is required.

    Raises
    ------
    InvalidInput
        The key is missing, or names no kind.
    """
    choices = tuple(makers)
    return table.text("kind", choices=choices) if default is None else table.text("kind", default, choices=choices)


def read_kind(table: Table, makers: Mapping[str, Maker], folder: Path) -> Any:
    """Make what a table describes with the maker that its key `kind` names; the table is read to its last key."""
    return _whole(table, makers[table.text("kind", choices=tuple(makers))], folder)


def _whole(table: Table, maker: Maker, folder: Path) -> Any:
    items = [item for item in items_of(maker) if item.key.in_file]
    values = _read_items(table, items, folder, None, complete=True)
    table.done()  # before the values meet: a misspelt key explains why they do not fit
    return made(table, maker, maker, values)


def made(table: Table, maker: Any, make: Maker, values: Values, prefix: str = "") -> Any:
    """Make settings of the values of attributes; an error names the keys of the table, which `maker` declares.

    Raises
    ------
    InvalidInput
        The values are not allowed.
    """
    with named(table):
        try:
            return make(**values)
        except Contradiction as error:
            if not {name.partition(".")[0] for name in error.names} <= {item.name for item in items_of(maker)}:
                raise  # of something that the maker makes of the values
            given = zip(error.names, error.values, strict=True)
            keys = (_key_and_value(table, maker, name, each, prefix) for name, each in given)
            raise InvalidInput(f"{table.source}: {error.rule.format(*keys)}") from None


def _key_and_value(table: Table, maker: Any, path: str, value: Any, prefix: str) -> str:
    """An attribute as the file has it, or by the key that it would have there."""
    name, _, inner = path.partition(".")
    item = next(each for each in items_of(maker) if each.name == name)
    table = table.table(item.key.table) if item.key.table else table
    if inner:
        return _key_and_value(table.table(item.names[0]), item.type, inner, value, prefix)
    for each in reversed(table.names([prefix + key for key in item.names])):
        if each in table.values:
            return f"{table.path(each)} = {table.values[each]!r}"
    [key] = table.names([prefix + item.exact_name])
    return f"{table.path(key)} = {unit_of(key).from_si(value)!r} (the default)"


def values_of(described: Any, maker: Any = None, only: Collection[str] | None = None) -> Values:
    """The keys and values of a table that reads as these settings; left out is what is None, or a later key's default.

    Parameters
    ----------
    described : object
        Has the declared attributes.
    maker : class or function, optional
        Declares them; None: the object's class.
    only : collection of str, optional
        The attributes to write, in that order.
    """
    values: Values = {}
    items = {item.name: item for item in items_of(maker or type(described)) if item.key.in_file}
    for item in items.values() if only is None else (items[name] for name in only):
        here = values.setdefault(item.key.table, {}) if item.key.table else values
        given = getattr(described, item.name)
        if item.key.switch:
            here[item.key.switch] = given is not None
        if given is None or (item.key.later and given == item.default):
            continue
        if item.key.prefix is not None:
            here.update({item.key.prefix + name: each for name, each in values_of(given).items()})
        else:
            here[item.exact_name] = _written(item, given)
    return values


def _written(item: Item, given: Any) -> Any:
    """The value of a key, or the values of a table."""
    if item.form is Form.TABLES:
        return [(item.key.dump or values_of)(each) for each in given]
    if item.form is Form.TABLE:
        return (item.key.dump or values_of)(given)
    unit = unit_of(item.exact_name)
    if unit.exact or isinstance(given, bool | str):
        return str(given) if isinstance(given, Path) else given
    return tuple(unit.from_si(each) for each in given) if isinstance(given, tuple) else unit.from_si(given)


def dumps(values: Mapping[str, Any]) -> str:
    """The text of a TOML file: plain values first, then the tables, each number with every digit that it has."""
    return "\n".join(_lines("", values)).lstrip("\n") + "\n"


def _lines(path: str, values: Mapping[str, Any]) -> list[str]:
    inner = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    lines = ["", f"[{path}]"] if path else []
    lines += [f"{key} = {_literal(value)}" for key, value in values.items() if key not in inner]
    for key, value in inner.items():
        lines += _lines(f"{path}.{key}" if path else key, value)
    return lines


def _literal(value: object) -> str:
    """A TOML value."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON strings are TOML strings, except that TOML also requires an escape for DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_literal, value))}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_literal(each)}" for key, each in value.items()) + "}"
    return repr(value)
