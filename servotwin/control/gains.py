"""Gains: the numbers of a law, of each kind, that the twin may set; they cross the link."""

from typing import Any, overload

import msgspec

from servotwin.config.keys import items_of
from servotwin.config.table import Table
from servotwin.config.toml import Values, changes, made, values_of
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_law_file import matrices_law
from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains

_KINDS: dict[type, type[AnyGains]] = {Controller: Gains, Cascade: CascadeGains, LinearLaw: LinearGains}
# Declares the keys of a law that is no settings class.
_MAKERS: dict[type, Any] = {LinearLaw: matrices_law}
# What a cascade lacks is None, and 0 in its gains.
_MAY_LACK = ("velocity_gain", "integral_time", "notch_hz")


@overload
def gains_of(controller: Controller) -> Gains: ...
@overload
def gains_of(controller: AnyController) -> AnyGains: ...
def gains_of(controller: AnyController) -> AnyGains:
    """The part of a controller that updates may set."""
    kind = _KINDS[type(controller)]
    values = {name: getattr(controller, name) for name in kind.__struct_fields__}
    return msgspec.convert(
        {name: each if name == "integral_only" else float(each or 0.0) for name, each in values.items()}, kind
    )


@overload
def with_gains(controller: Controller, gains: AnyGains | None) -> Controller: ...
@overload
def with_gains(controller: AnyController, gains: AnyGains | None) -> AnyController: ...
def with_gains(controller: AnyController, gains: AnyGains | None) -> AnyController:
    """The controller with other gains; its limits, filters and rates stay.

    Raises
    ------
    InvalidInput
        The gains are those of another kind of controller, or of another structure of the same kind.
    """
    if gains is None:
        return controller
    if not fits(controller, gains):
        raise InvalidInput(f"gains = {gains!r}: must be those of a {type(controller).__name__}")
    values = msgspec.structs.asdict(gains)
    if isinstance(gains, CascadeGains):
        values |= {name: values[name] or None for name in _MAY_LACK}
    return controller.replace(**values)


def fits(controller: AnyController, gains: AnyGains) -> bool:
    """True where the gains are those of a controller of this kind; a velocity loop neither appears nor goes."""
    if isinstance(controller, Cascade) and isinstance(gains, CascadeGains):
        return (gains.velocity_gain > 0.0) == (controller.velocity_gain is not None)
    return isinstance(gains, _KINDS[type(controller)])


def holds(controller: AnyController, gains: AnyGains | None) -> bool:
    """True where `with_gains` makes a controller."""
    try:
        with_gains(controller, gains)
    except InvalidInput:
        return False
    return True


def read_gains(table: Table, running: AnyController) -> AnyGains:
    """The gains that a table gives, with those of the running controller for the others."""
    kind = type(running)
    return gains_of(made(table, _MAKERS.get(kind, kind), running.replace, _changes(table, kind)))


def has_gains(table: Table, kind: type = Controller) -> bool:
    """True when a table gives any gain."""
    return bool(_changes(table, kind))


def _changes(table: Table, kind: type) -> Values:
    return changes(table, _MAKERS.get(kind, kind), only=settable(kind))


def written_gains(gains: AnyGains, running: AnyController | None = None) -> Values:
    """The keys and values of a table that `read_gains` reads as these gains.

    Raises
    ------
    InvalidInput
        The gains are not those of the running law.
    """
    if isinstance(gains, Gains):
        written: AnyController = Controller(**msgspec.structs.asdict(gains))
    else:
        if running is None:
            raise InvalidInput(f"gains = {gains!r}: must come with the law that they belong to")
        written = with_gains(running, gains)
    values = values_of(written, _MAKERS.get(type(written)), only=settable(type(written)))
    # Where nothing is said of them, a reader takes those of the running law.
    lacking = {"integral_time_s": 0.0, "notch_hz": 0.0} if isinstance(written, Cascade) else {}
    return {**lacking, **values}


def key_of(controller: AnyController, name: str) -> str:
    """Key in a file of a number of a controller's gains; the name itself of one that no file has."""
    items = items_of(_MAKERS.get(type(controller), type(controller)))
    return next((item.exact_name for item in items if item.name == name), name)


def settable(kind: type) -> tuple[str, ...]:
    """Names of the fields of a class of controllers that updates may set."""
    return _KINDS[kind].__struct_fields__
