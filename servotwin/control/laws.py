"""The kinds of controllers."""

from abc import ABC
from typing import TYPE_CHECKING, Any, TypeAlias

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput

Law: TypeAlias = Controller | LinearLaw
"""A law that runs: the filtered PID, or a linear law."""
AnyController: TypeAlias = Controller | Cascade | LinearLaw
"""A controller that an axis can have; a cascade is a description of a linear law."""


if TYPE_CHECKING:
    StoredController: TypeAlias = AnyController
else:

    class StoredController(ABC):  # noqa: B024 - it has nothing of its own
        """`AnyController` as a field of what files store; `kind_of_stored` tells a decoder which it is."""

    for _kind in (Controller, Cascade, LinearLaw):
        StoredController.register(_kind)


FILTERED_PID, CASCADE, LINEAR_LAW = "filtered_pid", "cascade", "linear"
CONTROLLERS: dict[str, type] = {FILTERED_PID: Controller, CASCADE: Cascade}
"""Controllers that a file can describe, by their key `kind`; linear laws beside them (`control.linear_law_file`)."""


def law_of(controller: AnyController) -> Law:
    """The law that runs, its gains in its matrices."""
    return controller if isinstance(controller, Controller) else controller.linear()


def kind_of(controller: AnyController) -> str:
    """The key `kind` of a controller in a file."""
    if isinstance(controller, LinearLaw):
        return LINEAR_LAW
    return CASCADE if isinstance(controller, Cascade) else FILTERED_PID


def kind_of_stored(values: dict[str, Any]) -> type:
    """The class of controllers that fields by name are of."""
    return Controller if "Kp" in values else Cascade if "position_gain" in values else LinearLaw


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
