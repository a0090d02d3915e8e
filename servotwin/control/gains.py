"""The part of a controller that crosses the link."""

import msgspec

from servotwin.control.controller import Controller
from servotwin.messages import Gains


def gains_of(controller: Controller) -> Gains:
    """The part of a controller that updates may set."""
    return Gains(*(float(getattr(controller, name)) for name in Gains.__struct_fields__))


def with_gains(controller: Controller, gains: Gains | None) -> Controller:
    """The controller with other gains; its limits, filters and rates stay."""
    return controller if gains is None else controller.replace(**msgspec.structs.asdict(gains))
