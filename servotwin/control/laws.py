"""The kinds of controllers."""

from typing import TypeAlias

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput

Law: TypeAlias = Controller | LinearLaw
"""A law that runs: the filtered PID, or a linear law."""
AnyController: TypeAlias = Controller | Cascade | LinearLaw
"""A controller that an axis can have; a cascade is a description of a linear law."""


def law_of(controller: AnyController) -> Law:
    """The law that runs."""
    return controller.linear() if isinstance(controller, Cascade) else controller


def filtered_pid(controller: AnyController) -> Controller:
    """The controller itself, where a computation is made for the filtered PID only.

    Raises
    ------
    InvalidInput
        It is another one.
    """
    if isinstance(controller, Controller):
        return controller
    raise InvalidInput(f"controller = {controller!r}: must be a Controller, a filtered PID, for this computation")
