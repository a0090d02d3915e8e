"""Parts of an axis with some of their numbers multiplied."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

from servotwin.errors import InvalidInput
from servotwin.plant.actuator import Actuator
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
    k, c, m, p = (factors.get(name, 1.0) for name in ("k", "c", "m", "p"))
    scaled_load = dataclasses.replace(
        load,
        m=tuple(m * each for each in load.m),
        k=tuple(k * each for each in load.k),
        c=tuple(c * each for each in load.c),
    )
    scaled_screw = dataclasses.replace(screw, p=p * screw.p, k_d=k * screw.k_d, c_d=c * screw.c_d)
    return actuator.scaled(factors.get("k_T", 1.0), factors.get("k_B", 1.0)), scaled_screw, scaled_load
