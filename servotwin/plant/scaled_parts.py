"""Parts of an axis with some of their numbers multiplied."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

from servotwin.errors import InvalidInput
from servotwin.plant.actuator import Actuator, Stepper, VelocityDrive
from servotwin.plant.load import Load
from servotwin.plant.transmission import Transmission


def scaled_parts(
    actuator: Actuator, screw: Transmission, load: Load, factors: Mapping[str, float]
) -> tuple[Actuator, Transmission, Load]:
    """Actuator, transmission and load with numbers multiplied; see `Axis.scaled`.

    Raises
    ------
    InvalidInput
        A factor is not positive and finite.
    """
    for name, factor in factors.items():
        if not 0.0 < factor < math.inf:
            raise InvalidInput(f"axis {name}: factor {factor!r} must be positive and finite")
    k, c, m, p, held = (factors.get(name, 1.0) for name in ("k", "c", "m", "p", "load_friction"))
    scaled_load = dataclasses.replace(
        load,
        m=tuple(m * each for each in load.m),
        k=tuple(k * each for each in load.k),
        c=tuple(c * each for each in load.c),
        friction=held * load.friction,
        static=None if load.static is None else held * load.static,
    )
    scaled_screw = dataclasses.replace(screw, p=p * screw.p, k_d=k * screw.k_d, c_d=c * screw.c_d)
    driven = actuator.scaled(factors.get("k_T", 1.0), factors.get("k_B", 1.0))
    return _with_friction(driven, factors.get("motor_friction", 1.0)), scaled_screw, scaled_load


def _with_friction(actuator: Actuator, factor: float) -> Actuator:
    """The actuator with its Coulomb and static friction multiplied; a drive that follows its command has none."""
    if isinstance(actuator, VelocityDrive | Stepper) or factor == 1.0:
        return actuator
    static = None if actuator.static is None else factor * actuator.static
    return dataclasses.replace(actuator, coulomb=factor * actuator.coulomb, static=static)
