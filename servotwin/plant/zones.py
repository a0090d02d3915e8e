"""The continuous controller's linear pieces: dead zone {-, inside, +} times optional saturation {low, linear, high}."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servotwin.control.controller import Controller
from servotwin.plant.basis import Basis
from servotwin.plant.signals import Array


@dataclass(frozen=True)
class Zone:
    """One linear piece of the controller: rows of the voltage and of its states' derivatives, and guards (row, target
    zone, label, side)."""

    name: str
    voltage: Array
    integral: Array
    derivative: Array
    guards: tuple[tuple[Array, str, str, int], ...] = ()


def controller_zones(controller: Controller, dead_zone: bool, basis: Basis, error: Array) -> tuple[Zone, ...]:
    """Eq 14 driven by the dead-zone error of Eq 20, gated to zero inside (erratum E16), plus what is always added."""
    always = basis.row("feedforward") + basis.row("offset")
    slope = error - basis.row("derivative")
    wanted = always + controller.Kp * error + basis.row("integral") + (controller.Kd / controller.Tf) * slope
    tolerance = basis.row("tolerance")
    back = 1.0 / max(controller.tracking, controller.Tf * 1e-3)
    zones: list[Zone] = []
    for side in (-1, 1) if dead_zone else (0,):
        name = {-1: "-", 0: "on", 1: "+"}[side]
        guards = ((controller.enter * tolerance - side * error, "inside", "enter", side),) if side else ()
        linear = Zone(name, wanted, controller.Ki * error, slope / controller.Tf, guards)
        zones += _saturated(linear, basis, back)
    if dead_zone:
        leave = tuple((s * error - controller.leave * tolerance, "+" if s > 0 else "-", "leave", s) for s in (1, -1))
        zero = np.zeros(len(basis.names))
        inside = Zone("inside", always, zero, -basis.row("derivative") / controller.Tf, leave)
        zones += _saturated(inside, basis, 0.0) if always.any() else [inside]
    return tuple(zones)


def _saturated(zone: Zone, basis: Basis, back: float) -> list[Zone]:
    """A linear zone, and with a voltage limit its two saturated ones with back-calculation at the rate `back` (1/s)."""
    if "voltage limit" not in basis:
        return [zone]
    limit, wanted = basis.row("voltage limit"), zone.voltage
    ends = tuple(
        (side * wanted - limit, zone.name + suffix, "saturate", side) for side, suffix in ((1, " high"), (-1, " low"))
    )
    zones = [replace(zone, guards=(*zone.guards, *ends))]
    for side, suffix in ((1, " high"), (-1, " low")):
        leave = (*zone.guards, (limit - side * wanted, zone.name, "saturate", 0))
        integral = zone.integral + back * (side * limit - wanted)
        zones.append(Zone(zone.name + suffix, side * limit, integral, zone.derivative, leave))
    return zones
