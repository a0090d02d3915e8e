"""Numbers of an axis by the names of the output-error fit's unknowns, and the axis with fitted ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from servotwin.estimation.output_error.held_chain import (
    DAMPING,
    FORCE,
    FRICTION,
    MASS_RATIO,
    STIFFNESS,
    MovingChain,
    follows,
)
from servotwin.plant.axis import Axis


def own_number(axis: Axis, name: str) -> float:
    """The axis's own number of a name, in its unit; of several that share a factor the first."""
    load, screw = axis.load, axis.transmission
    plain = {
        "ratio": axis.p,
        "shaft stiffness": screw.k_d,
        "shaft damping": screw.c_d,
        "load stiffness": _first(load.k),
        "load damping": _first(load.c),
        FRICTION: load.friction,
        FORCE: load.force,
    }
    if name in plain:
        return plain[name]
    chain = MovingChain.of(axis)
    if name == MASS_RATIO:
        return float(chain.m[-1] / chain.m[0])
    return {STIFFNESS: chain.k_d, DAMPING: _first((chain.c_d, *chain.c.tolist()))}[name]


def _first(numbers: tuple[float, ...]) -> float:
    """The first that is not 0."""
    return next((number for number in numbers if number), 0.0)


def adapted(axis: Axis, values: Mapping[str, float]) -> Axis:
    """The axis with logarithms of factors on its numbers, by the fit's names."""
    factors = {name: math.exp(value) for name, value in values.items()}
    ratio, friction = factors.get("ratio", 1.0), factors.get(FRICTION, 1.0)
    if follows(axis):
        return axis.scaled({"p": ratio})
    everything = {"k": factors.get(STIFFNESS, 1.0), "c": factors.get(DAMPING, 1.0)}
    scaled = axis.scaled({"p": ratio, "load_friction": friction, **everything})
    load, screw = scaled.load, scaled.transmission
    return scaled.replace(
        transmission=replace(
            screw,
            k_d=factors.get("shaft stiffness", 1.0) * screw.k_d,
            c_d=factors.get("shaft damping", 1.0) * screw.c_d,
        ),
        load=replace(
            load,
            m=(*load.m[:-1], factors.get(MASS_RATIO, 1.0) * load.m[-1]),
            k=tuple(factors.get("load stiffness", 1.0) * each for each in load.k),
            c=tuple(factors.get("load damping", 1.0) * each for each in load.c),
            force=factors.get(FORCE, 1.0) * load.force,
        ),
    )
