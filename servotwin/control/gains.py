"""Gains: the part of a controller that crosses the link."""

import msgspec

from servotwin.config.table import Table
from servotwin.config.toml import Values, changes, values_of
from servotwin.control.controller import Controller
from servotwin.messages import Gains


def gains_of(controller: Controller) -> Gains:
    """The part of a controller that updates may set."""
    floats = {name: float(getattr(controller, name)) for name in Gains.__struct_fields__ if name != "integral_only"}
    return msgspec.convert({**floats, "integral_only": controller.integral_only}, Gains)


def with_gains(controller: Controller, gains: Gains | None) -> Controller:
    """The controller with other gains; its limits, filters and rates stay."""
    return controller if gains is None else controller.replace(**msgspec.structs.asdict(gains))


def read_gains(table: Table, running: Controller) -> Gains:
    """The gains that a table gives, with those of the running controller for the others."""
    return gains_of(running.replace(**changes(table, Controller, only=Gains.__struct_fields__)))


def has_gains(table: Table) -> bool:
    """True when a table gives any gain."""
    return bool(changes(table, Controller, only=Gains.__struct_fields__))


def written_gains(gains: Gains) -> Values:
    """The keys and values of a table that `read_gains` reads as these gains."""
    written = Controller(**msgspec.structs.asdict(gains))
    return values_of(written, only=Gains.__struct_fields__)
