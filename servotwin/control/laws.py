"""The kinds of controllers."""

from typing import TypeAlias

from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput

Law: TypeAlias = Controller | LinearLaw
"""A controller that an axis can have: the filtered PID or any linear law."""


def filtered_pid(law: Law) -> Controller:
    """The law itself, where a computation is made for the filtered PID only.

    Raises
    ------
    InvalidInput
        It is a linear law.
    """
    if isinstance(law, Controller):
        return law
    raise InvalidInput(f"controller = {law!r}: must be a Controller, a filtered PID, for this computation")
