"""Keywords of `Servo.replace` and `Axis.replace`, for type checkers, and the refusal of others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

from servotwin.config.table import did_you_mean
from servotwin.control.controller import ControllerChanges
from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import Actuator
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.transmission import Transmission

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


class AxisChanges(ControllerChanges, total=False):
    """The keywords of `Axis.replace`: its parts and the fields of its controller, each of them optional."""

    actuator: Actuator
    transmission: Transmission
    load: Load
    controller: AnyController
    sensors: Sensors


def refuse_unknown(given: Iterable[str], known: Sequence[str], what: str) -> None:
    """Raise InvalidInput for a name that is not known; `what` has no such name."""
    for name in given:
        if name not in known:
            raise InvalidInput(f"{what} named {name!r}{did_you_mean(name, known)}; allowed are {', '.join(known)}")
