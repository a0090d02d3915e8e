"""Systems of a servo for python-control."""

from __future__ import annotations

from typing import Any, NamedTuple

from servotwin.plant.linear import LinearSystem


class Control(NamedTuple):
    """A servo's systems as python-control StateSpace objects."""

    G1: Any
    G2: Any
    C: Any
    loop: Any
    closed_loop: Any

    @classmethod
    def of(cls, *systems: LinearSystem) -> Control:
        """Convert G1, G2, C, the loop and the closed loop (needs the extra `interop`)."""
        return cls(*(system.to_control() for system in systems))
