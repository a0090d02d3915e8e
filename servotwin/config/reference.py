"""Reference of a file's keys as Markdown and JSON Schema, generated from the declarations of `config.keys`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from servotwin.config.keys import ORDERED, Form, Item, Maker, items_of
from servotwin.config.own_units import OwnUnits
from servotwin.config.units import unit_of

_Schema = dict[str, Any]


@dataclass(frozen=True)
class TableSpec:
    """The keys of one table of a file.

    Parameters
    ----------
    makers : tuple of class or function
        Declare keys that lie in this table.
    help : str
        One sentence.
    tables : mapping of str to TableSpec
        Inner tables that no attribute declares.
    kinds : mapping of str to TableSpec
        The table is of one of these kinds.
    only : tuple of str, optional
        Attributes to include; None: all.
    partial : bool
        No key has to be given, as another table has the values.
    repeated : str
        Name of the inner tables, where the table holds any number of them.
    text : bool
        True: the table holds any keys, with texts as values.
    units : tuple of OwnUnits
        Units in which its keys, and those of the tables within it, may be named; empty: as they are declared.
    """

    makers: tuple[Maker, ...] = ()
    help: str = ""
    tables: Mapping[str, TableSpec] = field(default_factory=dict)
    kinds: Mapping[str, TableSpec] = field(default_factory=dict)
    only: tuple[str, ...] | None = None
    partial: bool = False
    repeated: str = ""
    text: bool = False
    units: tuple[OwnUnits, ...] = ()

    def items(self) -> tuple[Item, ...]:
        """The attributes with a key in this table or in an inner one."""
        items = (item for maker in self.makers for item in items_of(maker) if item.key.in_file)
        named = (self._named(item) for item in items if self.only is None or item.name in self.only)
        # The first of those who declare the same key describes it.
        first: dict[tuple[str, str], Item] = {}
        for item in named:
            first.setdefault((item.key.table, item.exact_name), item)
        return tuple(first.values())

    def _named(self, item: Item) -> Item:
        if not self.units:
            return item
        names = dict.fromkeys(name for units in self.units for name in units.keys(item.names))
        return replace(item, key=replace(item.key, names=tuple(names)))


def in_units(spec: TableSpec, units: tuple[OwnUnits, ...]) -> TableSpec:
    """The keys of a table, and of all within it, in other units."""
    tables, kinds = (
        {name: in_units(each, units) for name, each in inner.items()} for inner in (spec.tables, spec.kinds)
    )
    return replace(spec, tables=tables, kinds=kinds, units=units)


def markdown(title: str, spec: TableSpec) -> str:
    """The reference of one kind of file: a section per table."""
    return "\n".join([f"## {title}", "", *_sections("", spec)])


def schema(title: str, spec: TableSpec) -> _Schema:
    """The JSON Schema of one kind of file."""
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": title, **_object(spec)}


def _flat(items: tuple[Item, ...]) -> Iterator[tuple[str, Item, str]]:
    """Every plain key: the inner table that holds it, its attribute, and a prefix of its name."""
    for item in items:
        if item.key.prefix is not None:
            yield from ((item.key.table, each, item.key.prefix) for each in items_of(item.type))
        elif item.form not in (Form.TABLE, Form.TABLES):
            yield item.key.table, item, ""


def _inner(item: Item, units: tuple[OwnUnits, ...]) -> TableSpec:
    """The table that an attribute is read from."""
    makers = item.makers
    if len(makers) == 1:
        return TableSpec((next(iter(makers.values())),), item.key.help, units=units)
    tagged = item.key.select is None
    kinds = {f'kind = "{name}"' if tagged else name: TableSpec((made,), units=units) for name, made in makers.items()}
    return TableSpec(help=item.key.help, kinds=kinds)


def _sections(path: str, spec: TableSpec) -> list[str]:
    lines = [f"### `[{path}]`", "", *([spec.help, ""] if spec.help else [])] if path else []
    for kind, inner in spec.kinds.items():
        lines += [f"{_describe(kind, inner)}:", "", *_rows(inner, "")]
    groups = dict.fromkeys(table for table, _, _ in _flat(spec.items()))
    if "" in groups:
        lines += _rows(spec, "")
    for table in groups:
        if table:
            lines += [f"### `[{_join(path, table)}]`", "", *_rows(spec, table)]
    for item in spec.items():
        if item.form in (Form.TABLE, Form.TABLES) and item.key.prefix is None:
            below = _join(path, item.key.table)
            inner_path = _join(below, item.names[0])
            lines += _sections(f"[{inner_path}]" if item.form is Form.TABLES else inner_path, _inner(item, spec.units))
    for key, inner in spec.tables.items():
        lines += _sections(_join(path, key), inner)
    return lines


def _describe(kind: str, spec: TableSpec) -> str:
    """Heading of a kind of table: its key and first sentence."""
    text = inspect.getdoc(spec.makers[0]) if spec.makers else ""
    sentence = (text or "").partition("\n")[0].rstrip(".")
    # Not of an abbreviation.
    lowered = sentence if sentence[1:2].isupper() else sentence[:1].lower() + sentence[1:]
    return f"`{kind}`, {lowered}" if "=" in kind else sentence


def _rows(spec: TableSpec, table: str) -> list[str]:
    lines = ["| key | unit | default | allowed | meaning |", "|---|---|---|---|---|"]
    for where, item, prefix in _flat(spec.items()):
        if where != table:
            continue
        if item.key.switch:
            lines.append(f"| `{item.key.switch}` | | true | true or false | {item.key.help} |")
        names = ", ".join(f"`{prefix}{name}`" for name in item.names)
        units = ", ".join(dict.fromkeys(unit_of(name).name or item.key.unit for name in item.names))
        default = "" if spec.partial else _default(item)
        lines.append(f"| {names} | {units} | {default} | {_allowed(item)} | {item.key.help} |")
    return [*lines, ""]


def _default(item: Item) -> str:
    if item.required:
        return "required"
    if item.default is None:
        return ""
    if isinstance(item.default, bool):
        return str(item.default).lower()
    if isinstance(item.default, str):
        return f'"{item.default}"'
    numbers = item.default if isinstance(item.default, tuple) else (item.default,)
    if not all(isinstance(number, int | float) for number in numbers):
        return str(item.default)
    shown = [f"{unit_of(item.names[0]).from_si(number):.10g}" for number in numbers]
    return f"[{', '.join(shown)}]" if isinstance(item.default, tuple) else shown[0]


def _allowed(item: Item) -> str:
    if item.key.choices is not None:
        return ", ".join(f'"{choice}"' for choice in item.key.choices)
    words = item.key.range.scaled(unit_of(item.names[0]).from_si)
    return {
        Form.NUMBER: str(words),
        Form.INTEGER: words.whole if unit_of(item.names[0]).exact else str(words),
        Form.PAIR: f"two numbers, each {words}{ORDERED if item.key.ordered else ''}",
        Form.NUMBERS: f"{words} or a list of such",
        Form.BOOLEAN: "true or false",
        Form.TEXT: "text",
        Form.PATH: "path, relative to this file",
    }.get(item.form, "")


def _object(spec: TableSpec) -> _Schema:
    """The schema of a table."""
    if spec.kinds:
        return {"anyOf": [_kind(name, inner) for name, inner in spec.kinds.items()]}
    if spec.repeated:
        return {"type": "object", "additionalProperties": _object(spec.tables[spec.repeated])}
    if spec.text:
        return {"type": "object", "additionalProperties": {"type": "string"}}
    top: _Schema = {"type": "object", "additionalProperties": False, "properties": {}}
    for table, item, prefix in _flat(spec.items()):
        here = _at(top, table)
        for name in item.names:
            here["properties"][prefix + name] = _value(item, name)
        _require(here, item, spec)
    for item in spec.items():
        if item.form not in (Form.TABLE, Form.TABLES) or item.key.prefix is not None:
            continue
        here, inner = _at(top, item.key.table), _object(_inner(item, spec.units))
        described = {"description": item.key.help, **inner}
        here["properties"][item.names[0]] = (
            {"type": "array", "items": described} if item.form is Form.TABLES else described
        )
        if item.key.switch:
            here["properties"][item.key.switch] = {"type": "boolean"}
        _require(here, item, spec)
    for name, table_spec in spec.tables.items():
        top["properties"][name] = {"description": table_spec.help, **_object(table_spec)}
    return top


def _kind(name: str, spec: TableSpec) -> _Schema:
    described = _object(spec)
    if "=" in name:
        described["properties"]["kind"] = {"const": name.partition('"')[2].rstrip('"')}
        described["required"] = ["kind", *described.get("required", [])]
    return described


def _at(top: _Schema, table: str) -> _Schema:
    if not table:
        return top
    empty: _Schema = {"type": "object", "additionalProperties": False, "properties": {}}
    inner: _Schema = top["properties"].setdefault(table, empty)
    return inner


def _require(here: _Schema, item: Item, spec: TableSpec) -> None:
    if item.required and not spec.partial and len(item.names) == 1:
        here.setdefault("required", []).append(item.names[0])


def _value(item: Item, name: str) -> _Schema:
    number = {"type": "number", **_limits(item, name)}
    whole = {"type": "integer", **_limits(item, name)}
    shapes: dict[Form, _Schema] = {
        Form.NUMBER: number,
        Form.INTEGER: whole if unit_of(name).exact else number,
        Form.PAIR: {"type": "array", "items": number, "minItems": 2, "maxItems": 2},
        Form.NUMBERS: {"anyOf": [number, {"type": "array", "items": number, "minItems": 1}]},
        Form.BOOLEAN: {"type": "boolean"},
        Form.TEXT: {"type": "string"} if item.key.choices is None else {"enum": list(item.key.choices)},
        Form.PATH: {"type": "string"},
    }
    unit = unit_of(name).name or item.key.unit
    return {"description": f"{item.key.help} Unit: {unit}." if unit else item.key.help, **shapes.get(item.form, {})}


def _limits(item: Item, name: str) -> _Schema:
    limits = item.key.range.scaled(unit_of(name).from_si)
    ends = {
        "minimum": limits.minimum,
        "maximum": limits.maximum,
        "exclusiveMinimum": limits.above,
        "exclusiveMaximum": limits.below,
    }
    return {key: float(f"{end:.12g}") for key, end in ends.items() if math.isfinite(end)}


def _join(path: str, name: str) -> str:
    return ".".join(part for part in (path, name) if part)
