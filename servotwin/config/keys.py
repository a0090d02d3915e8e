"""Settings declared once: TOML key, unit, range and help stand in the annotation of the attribute that they set.

    @settings("retry")
    @dataclass(frozen=True)
    class Retry:
        \"\"\"When to repeat a message.\"\"\"

        first_s: Annotated[float, key(above=0.0, help="First pause.")] = 5.0
        size: Annotated[float, key("size_mm", "size_m", minimum=0.0, help="Largest move.")] = 0.0

        def __post_init__(self) -> None:
            check(self)

The reader and the writer (`config.toml`), the check in the constructor, the class's docstring, the reference in docs/
and the JSON Schemas are all made of this. A plain function with annotated parameters declares a table as well.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import textwrap
import typing
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass
from enum import StrEnum
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar

from servotwin.config.own_units import at_load
from servotwin.config.range import Range
from servotwin.config.table import Table, did_you_mean
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput

_Class = TypeVar("_Class", bound=type)
_Described = TypeVar("_Described", bound=Any)
Maker = Callable[..., Any]
"""A class, or a function, whose parameters a table declares."""
_ITEMS: dict[Any, tuple[Item, ...]] = {}


class Form(StrEnum):
    """Form of an attribute's value in a file."""

    NUMBER = "number"
    INTEGER = "integer"
    PAIR = "pair of numbers"
    NUMBERS = "number or list of numbers"
    BOOLEAN = "true or false"
    TEXT = "text"
    PATH = "path"
    TABLE = "table"
    TABLES = "array of tables"
    OTHER = "value"


ANY = Range()


ORDERED = ", the lower one first"


@dataclass(frozen=True)
class Key:
    """The metadata of one attribute; `key` and `value` make it."""

    names: tuple[str, ...] = ()
    unit: str = ""
    range: Range = ANY
    help: str = ""
    table: str = ""
    choices: tuple[str, ...] | None = None
    prefix: str | None = None
    switch: str = ""
    relative: bool = False
    required: bool = False
    makers: Mapping[str, Maker] | None = None
    select: Callable[[Table], Maker] | None = None
    parse: Callable[[Table, str, Any, Path], Any] | None = None
    dump: Callable[[Any], dict[str, Any]] | None = None
    form: Form | None = None
    in_file: bool = True
    later: bool = False
    ordered: bool = False
    at_load: bool = False


def key(
    *names: str,
    minimum: float = -math.inf,
    above: float = -math.inf,
    maximum: float = math.inf,
    below: float = math.inf,
    infinite: bool = False,
    unit: str = "",
    help: str = "",  # noqa: A002
    table: str = "",
    choices: tuple[str, ...] | None = None,
    prefix: str | None = None,
    switch: str = "",
    relative: bool = False,
    required: bool = False,
    makers: Mapping[str, Maker] | None = None,
    select: Callable[[Table], Maker] | None = None,
    parse: Callable[[Table, str, Any, Path], Any] | None = None,
    dump: Callable[[Any], dict[str, Any]] | None = None,
    form: Form | None = None,
    later: bool = False,
    ordered: bool = False,
    at_load: bool = False,
) -> Key:
    """Declare the TOML key of an attribute.

    Parameters
    ----------
    names : str
        Keys that set it, each in the unit that its end says; the attribute's own name by default. Where a file has
        several of them, the last one counts.
    minimum, above, maximum, below, infinite
        Range, in the attribute's unit.
    unit : str
        The attribute's unit, where the key's end does not say it.
    help : str
    table : str
        Inner table that holds the key; that of the class by default.
    choices : tuple of str
    prefix : str
        For an attribute that is a declared class: its keys lie in the same table and begin with this.
    switch : str
        A key that is true or false, for an attribute that may be None; false: None.
    relative : bool
        The text is a path, relative to the file's folder.
    required : bool
        A file has to give the key, though the attribute has a default.
    makers : mapping
        Makers of the attribute from an inner table, by kind. The table's key `kind` chooses one, or `select` does; a
        single one needs neither.
    parse : callable
        Converts (table, key, value, folder that paths are relative to) to the attribute; raises `table.invalid`.
    dump : callable
        Keys and values of an attribute that `makers` makes.
    form : Form
        Form in a file of what `parse` converts.
    later : bool
        Released versions refuse the key: the default is not written, so that they read a file that does not need it.
    ordered : bool
        Of two numbers the first is at most the second.
    at_load : bool
        A gap, whose key counts at the motor; in its place a file may have one that counts at the load.
    """
    allowed = Range(minimum, maximum, above=above, below=below, infinite=infinite)
    return Key(
        names=names, unit=unit, range=allowed, help=help, table=table, choices=choices, prefix=prefix, switch=switch,
        relative=relative, required=required, makers=makers, select=select, parse=parse, dump=dump, form=form,
        later=later, ordered=ordered, at_load=at_load,
    )  # fmt: skip


def value(
    *,
    minimum: float = -math.inf,
    above: float = -math.inf,
    maximum: float = math.inf,
    below: float = math.inf,
    infinite: bool = False,
    choices: tuple[str, ...] | None = None,
    unit: str = "",
    help: str = "",  # noqa: A002
) -> Key:
    """Declare range and help of an attribute that no file sets."""
    allowed = Range(minimum, maximum, above=above, below=below, infinite=infinite)
    return Key((), unit, allowed, help, choices=choices, in_file=False)


@dataclass(frozen=True, slots=True)
class Item:
    """One declared attribute: its name, its type without None, its default and its key."""

    name: str
    type: Any
    optional: bool
    default: Any
    key: Key
    form: Form

    @property
    def names(self) -> tuple[str, ...]:
        """The keys that set it."""
        names = self.key.names or (self.name,)
        return (*names, *at_load(names[0])) if self.key.at_load else names

    @property
    def exact_name(self) -> str:
        """The key that holds it to the last bit, as far as there is one."""
        return next((name for name in self.names if unit_of(name).exact), self.names[0])

    @property
    def unit(self) -> str:
        """The attribute's unit."""
        return self.key.unit or unit_of(self.names[0]).si

    @property
    def required(self) -> bool:
        """True where a file has to give the attribute."""
        return self.default is MISSING or self.key.required

    @property
    def makers(self) -> Mapping[str, Maker]:
        """Makers of the attribute from an inner table, by kind."""
        return {"": self.type} if self.key.makers is None else self.key.makers


def items_of(maker: Any) -> tuple[Item, ...]:
    """The declared attributes of a class, or parameters of a function, in order."""
    known = _ITEMS.get(maker)
    if known is None:
        hints = typing.get_type_hints(maker, include_extras=True)
        items = (_item(name, hints[name], default) for name, default in _defaults(maker).items() if name in hints)
        known = _ITEMS[maker] = tuple(item for item in items if item is not None)
    return known


def name_of(described: Any) -> str:
    """Name of a declared class, or of its object, in messages."""
    return str(getattr(described, "settings_name", ""))


def settings(name: str) -> Callable[[_Class], _Class]:
    """Name a declared class for its messages, and complete its docstring from the declaration."""

    def decorate(described: _Class) -> _Class:
        described.settings_name = name  # type: ignore[attr-defined]
        described.__doc__ = documented(described)
        return described

    return decorate


def check(described: Any, but: Collection[str] = ()) -> None:
    """Refuse a value out of its declared range; for `__post_init__`.

    Parameters
    ----------
    but : collection of str
        Attributes for which the range holds in files only.

    Raises
    ------
    InvalidInput
        Naming the attribute, its value and unit, and what is allowed.
    """
    for item in items_of(type(described)):
        given = getattr(described, item.name)
        if (given is None and item.optional) or item.name in but or _fits(item, given):
            continue
        shown, words = item.name, allowed(item) + did_you_mean(str(given), item.key.choices or ())
        if item.form is Form.NUMBERS and isinstance(given, tuple) and given:
            index = next(i for i, each in enumerate(given) if not _number_fits(item, each))
            shown, given, words = f"{item.name}[{index}]", given[index], str(item.key.range)
        unit = f" {item.unit}" if item.unit else ""
        raise InvalidInput(f"{name_of(described)} {shown} = {given!r}{unit}: must be {words}".lstrip())


def replaced(described: _Described, name: str, changes: Mapping[str, Any]) -> _Described:
    """Copy a dataclass with some values changed, checked again; `name` says what it is.

    Raises
    ------
    InvalidInput
        A value does not exist, or is out of its range.
    """
    known = [each.name for each in dataclasses.fields(described)]
    if unknown := sorted(set(changes) - set(known)):
        raise InvalidInput(f"{name} has no value named {unknown[0]!r}: allowed are {', '.join(known)}")
    return dataclasses.replace(described, **changes)


def allowed(item: Item) -> str:
    """Allowed values of an attribute, in words."""
    if item.key.choices is not None:
        return f"one of {', '.join(item.key.choices)}"
    if item.form is Form.BOOLEAN:
        return "True or False"
    words = item.key.range.whole if item.form is Form.INTEGER else str(item.key.range)
    if item.form is Form.PAIR:
        return f"two numbers, each {words}{ORDERED if item.key.ordered else ''}"
    return f"{words} or a tuple of such" if item.form is Form.NUMBERS else words


def documented(described: type) -> str:
    """The docstring of a class with a section on its declared attributes."""
    text = inspect.cleandoc(described.__doc__ or "")
    lines = [line for item in items_of(described) if item.key.help for line in _parameter(item)]
    if not lines:
        return text
    section = "\n".join(["Parameters", "----------", *lines])
    head, separator, tail = text.partition("\nParameters\n----------\n")
    if separator:  # declared attributes come first, those documented by hand after them
        return f"{head}\n{section}\n{tail}"
    head, separator, tail = text.partition("\nRaises\n------")
    return f"{head.rstrip()}\n\n{section}\n" + (f"\nRaises\n------{tail}" if separator else "")


def _parameter(item: Item) -> list[str]:
    kind = getattr(item.type, "__name__", str(item.type)) if isinstance(item.type, type) else str(item.type)
    optional = ", optional" if item.optional else ""
    unit = f" In {item.unit}." if item.unit else ""
    help_lines = textwrap.wrap(f"{item.key.help}{unit}", 110, initial_indent="    ", subsequent_indent="    ")
    return [f"{item.name} : {kind}{optional}", *help_lines]


def _defaults(maker: Maker) -> dict[str, Any]:
    """The parameters' defaults; MISSING where one has to be given."""
    if dataclasses.is_dataclass(maker):
        return {field.name: _default(field) for field in dataclasses.fields(maker) if field.init}
    parameters = inspect.signature(maker).parameters.values()
    return {each.name: MISSING if each.default is each.empty else each.default for each in parameters}


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _item(name: str, hint: Any, default: Any) -> Item | None:
    if typing.get_origin(hint) is not Annotated:
        return None
    bare, *metadata = typing.get_args(hint)
    declared = next((each for each in metadata if isinstance(each, Key)), None)
    if declared is None:
        return None
    kinds = typing.get_args(bare) if isinstance(bare, UnionType) or typing.get_origin(bare) is typing.Union else ()
    optional = NoneType in kinds
    rest = [kind for kind in kinds if kind is not NoneType]
    if optional:
        bare = rest[0] if len(rest) == 1 else typing.Union[tuple(rest)]  # noqa: UP007
    return Item(name, bare, optional, default, declared, _form(bare, declared))


_FORMS: dict[Any, Form] = {
    float: Form.NUMBER, int: Form.INTEGER, bool: Form.BOOLEAN, str: Form.TEXT, Path: Form.PATH,
    tuple[float, float]: Form.PAIR, tuple[float, ...]: Form.NUMBERS, float | tuple[float, ...]: Form.NUMBERS,
}  # fmt: skip


def _form(bare: Any, declared: Key) -> Form:
    if declared.form is not None:
        return declared.form
    arguments = typing.get_args(bare)
    if len(arguments) == 2 and arguments[1] is ... and declared.makers is not None:
        return Form.TABLES
    if declared.makers is not None or (isinstance(bare, type) and dataclasses.is_dataclass(bare)):
        return Form.TABLE
    return Form.TEXT if declared.choices is not None else _FORMS.get(bare, Form.OTHER)


def _fits(item: Item, given: object) -> bool:
    """True where a value has the declared type and, if it is a number, lies in the range."""
    form = item.form
    if form is Form.NUMBER or form is Form.INTEGER:
        return _number_fits(item, given)
    if item.key.choices is not None:
        return isinstance(given, str) and given in item.key.choices
    if form is Form.BOOLEAN:
        return isinstance(given, bool)
    if form is Form.PAIR:
        pair = isinstance(given, tuple | list) and len(given) == 2 and all(_number_fits(item, each) for each in given)
        return pair and (not item.key.ordered or given[0] <= given[1])  # type: ignore[index]
    if form is Form.NUMBERS:
        each_of = given if isinstance(given, tuple | list) else (given,)
        return len(each_of) > 0 and all(_number_fits(item, each) for each in each_of)
    return True


def _number_fits(item: Item, given: object) -> bool:
    if type(given) is float or type(given) is int:  # the others are slow to look up
        return (item.form is not Form.INTEGER or type(given) is int) and item.key.range.accepts(given)
    kind = Integral if item.form is Form.INTEGER else Real
    return isinstance(given, kind) and not isinstance(given, bool) and item.key.range.accepts(float(given))
