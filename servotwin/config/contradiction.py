"""Values of declared settings that contradict each other: an error that `config.toml` says in the keys of a file."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

from servotwin.config.keys import items_of, name_of
from servotwin.errors import InvalidInput


class Contradiction(InvalidInput):
    """Values of declared settings that are allowed each by itself, but not together.

    Attributes
    ----------
    rule : str
        Names what is allowed; {0}, {1} stand for the attributes and their values.
    names : tuple of str
        The attributes, dotted where they are those of an attribute.
    values : tuple
    """

    rule: str
    names: tuple[str, ...]
    values: tuple[Any, ...]


def contradiction(described: Any, rule: str, *names: str) -> Contradiction:
    """The error for attributes that contradict each other; to be raised by the caller, in `__post_init__`."""
    values = tuple(attrgetter(name)(described) for name in names)
    shown = (_with_unit(type(described), name, each) for name, each in zip(names, values, strict=True))
    error = Contradiction(f"{name_of(described)} {rule.format(*shown)}".lstrip())
    error.rule, error.names, error.values = rule, names, values
    return error


def _with_unit(maker: Any, path: str, given: object) -> str:
    name, _, inner = path.partition(".")
    item = next((each for each in items_of(maker) if each.name == name), None)
    if item is not None and inner:
        return f"{name} {_with_unit(item.type, inner, given)}"
    return f"{path} = {given!r} {item.unit if item is not None else ''}".rstrip()
