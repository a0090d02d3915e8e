"""Keywords of `Servo.replace`, for type checkers."""

from __future__ import annotations

from typing import TypeAlias

from servotwin.control.controller import ControllerChanges
from servotwin.control.laws import AnyController

PerMass: TypeAlias = float | tuple[float, ...]
"""One number for all masses, or one for each."""


class ServoChanges(ControllerChanges, total=False):
    """The keywords of `Servo.replace`: the fields of `Servo` and of its `Controller`, each of them optional."""

    m: PerMass
    k: PerMass
    c: PerMass
    J: float
    p: float
    L: float
    R: float
    k_T: float
    k_B: float
    controller: AnyController
    n: int
    k_d: float
    encoder_resolution: float
    position_resolution: float
