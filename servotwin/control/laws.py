"""The kinds of controllers."""

from typing import TypeAlias

from servotwin.control.controller import Controller
from servotwin.control.linear_law import LinearLaw

Law: TypeAlias = Controller | LinearLaw
"""A controller that an axis can have: the filtered PID or any linear law."""
