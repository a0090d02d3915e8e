"""Matrices of the systems that other libraries make."""

from __future__ import annotations

from typing import Any

from servotwin.errors import InvalidInput
from servotwin.runtime.extras import require


def system_matrices(system: Any) -> tuple[list[Any], list[Any], list[Any], list[Any], float | None]:
    """Matrices of a system of scipy.signal or python-control, row by row, and its sample time."""
    if hasattr(system, "to_ss"):
        system = system.to_ss()
    elif type(system).__module__.startswith("control") and not hasattr(system, "A"):
        system = require("control", "a python-control system").ss(system)
    if not all(hasattr(system, name) for name in "ABCD"):
        raise InvalidInput(f"law system = {system!r}: must be a system of scipy.signal or python-control")
    if (step := getattr(system, "dt", None)) is True:
        raise InvalidInput("law system dt = True: a sampled system needs its sample time in s")
    A, B, C, D = (getattr(system, name).tolist() for name in "ABCD")
    return A, B, C, D, float(step) if step else None
