"""A continuous linear law with the plant, as one automaton: zones of dead zone and limit, exact between events."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from servotwin.control.linear_law import LinearLaw
from servotwin.plant.automaton import INPUTS, LoopModes, LoopParts, ServoAutomaton, Shape, constants
from servotwin.plant.basis import Basis, GuardRow, input_names, plant_names
from servotwin.plant.flow import mechanical_flow
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array
from servotwin.plant.zones import saturations


@dataclass(frozen=True)
class LawZone:
    """One linear piece of a law: row of the command, rows of its states' derivatives, guards."""

    name: str
    voltage: Array
    rates: Array
    guards: tuple[GuardRow, ...] = ()


def law_state(name: str) -> str:
    """Name of a law's state in the automaton."""
    return f"law {name}"


def linear_loop(servo: Plant, law: LinearLaw, shape: Shape) -> ServoAutomaton:
    """Plant and linear law together; one automaton for laws that differ in constant feedforwards only."""
    return _one_loop(servo, law.replace(feedforward=0.0), shape)


@lru_cache(maxsize=64)
def _one_loop(servo: Plant, law: LinearLaw, shape: Shape) -> ServoAutomaton:
    return linear_parts(servo, law, shape).assembled()


def linear_parts(servo: Plant, law: LinearLaw, shape: Shape) -> LoopParts:
    """Modes, guards and outputs of a plant and a linear law."""
    basis = Basis(tuple(_names(servo, law, shape)))
    load = basis.sensed(servo) + basis.row("noise")
    inputs = np.stack([basis.row("reference"), basis.row("theta_m"), load])
    by_motor, by_load = law.error
    measured = by_motor * inputs[1] + by_load * inputs[2]
    error = inputs[0] - measured
    modes = LoopModes(servo, basis, linear_zones(law, shape.dead_zone, basis, inputs, error), shape.friction)
    states = [basis[law_state(name)] for name in law.names]
    flows = []
    for contact, stick_slip, driven in modes.combinations:
        flow = mechanical_flow(servo, basis, contact, stick_slip, driven.command)
        flow[states] = driven.piece.rates
        if shape.offset:
            flow[basis["offset"]] = -basis.row("offset") / law.release
        flows.append(flow)
    return modes.parts(flows, error=error, measured_position=inputs[2])


def _names(servo: Plant, law: LinearLaw, shape: Shape) -> list[str]:
    names = plant_names(servo) + [law_state(name) for name in law.names]
    names += [name for key in INPUTS for name in input_names(key, getattr(shape, key))]
    names += ["voltage limit"] if law.voltage_limit is not None else []
    names += ["noise"] if shape.noise else []
    names += [name for name in ("feedforward", "offset") if getattr(shape, name)]
    return names + constants(servo, shape.bias, shape.friction)


def linear_zones(law: LinearLaw, dead_zone: bool, basis: Basis, inputs: Array, error: Array) -> tuple[LawZone, ...]:
    """Pieces of a law: dead zone {-, inside, +} times limit {low, linear, high}.

    Parameters
    ----------
    law : LinearLaw
    dead_zone : bool
    basis : Basis
    inputs : (3, N) array
        Rows of reference, y_motor and y_load.
    error : (N,) array
        Row of the error that the dead zone looks at.
    """
    tolerance = basis.row("tolerance")
    if not dead_zone:
        return tuple(_limited(_linear("on", law, basis, inputs), law, basis))
    zones: list[LawZone] = []
    for side, name in ((-1, "-"), (1, "+")):
        enter = GuardRow(law.enter * tolerance - side * error, "inside", None, "enter", side)
        zones += _limited(replace(_linear(name, law, basis, inputs), guards=(enter,)), law, basis)
    inside = law.inside()
    leave = tuple(
        GuardRow(side * error - law.leave * tolerance, "+" if side > 0 else "-", None, "leave", side)
        for side in (1, -1)
    )
    zones += _limited(replace(_linear("inside", inside, basis, inputs), guards=leave), inside, basis)
    return tuple(zones)


def _linear(name: str, law: LinearLaw, basis: Basis, inputs: Array) -> LawZone:
    states = np.array([basis.row(law_state(each)) for each in law.names]).reshape(law.n, len(basis.names))
    always = basis.row("feedforward") + basis.row("offset")
    command = always + np.array(law.C) @ states + np.array(law.D) @ inputs
    rates = np.array(law.A).reshape(law.n, law.n) @ states + np.array(law.B).reshape(law.n, 3) @ inputs
    return LawZone(name, command, rates)


def _limited(zone: LawZone, law: LinearLaw, basis: Basis) -> list[LawZone]:
    """The zone itself and, with a limit, its two saturated zones, with back-calculation."""
    if "voltage limit" not in basis or not zone.voltage.any():
        return [zone]
    limit, unlimited = basis.row("voltage limit"), zone.voltage
    ends = saturations(zone.name, unlimited, limit)
    zones = [replace(zone, guards=(*zone.guards, *(end.enter for end in ends)))]
    for end in ends:
        rates = zone.rates + np.outer(law.windup, end.side * limit - unlimited)
        zones.append(LawZone(end.enter.target, end.side * limit, rates, (*zone.guards, end.leave)))
    return zones
