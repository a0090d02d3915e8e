"""Zones of a continuous law: the linear pieces that dead zone and limit divide it into; and the drive's own limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from servotwin.plant.basis import Basis, GuardRow, LawNumbers
from servotwin.plant.signals import Array


class LinearPiece(Protocol):
    """One linear piece of any law."""

    @property
    def name(self) -> str: ...
    @property
    def voltage(self) -> Array:
        """Row of the command."""
        ...

    @property
    def guards(self) -> tuple[GuardRow, ...]: ...


Piece = TypeVar("Piece", bound=LinearPiece)


@dataclass(frozen=True)
class Driven(Generic[Piece]):
    """A linear piece of a law with what the drive makes of its command.

    Attributes
    ----------
    piece : LinearPiece
        Of the law, which does not know of the drive's limit.
    name : str
    command : (..., N) array
        Row of what the actuator gets, the input bias included.
    guards : tuple of GuardRow
        Those of the law, and of the drive's limit.
    """

    piece: Piece
    name: str
    command: Array
    guards: tuple[GuardRow, ...]


def driven_pieces(pieces: Sequence[Piece], basis: Basis) -> tuple[Driven[Piece], ...]:
    """Pieces of a law with an actuator's command; where the drive has a limit, each below, at and above it."""
    every: list[Driven[Piece]] = []
    for piece in pieces:
        given = piece.voltage + basis.row("input bias")
        if "drive limit" not in basis:
            every.append(Driven(piece, piece.name, given, tuple(piece.guards)))
            continue
        limit, suffixes = basis.row("drive limit"), {1: " limited high", -1: " limited low"}
        ends = [
            GuardRow(side * given - limit, piece.name + suffix, None, "limit", side)
            for side, suffix in suffixes.items()
        ]
        every.append(Driven(piece, piece.name, given, (*piece.guards, *ends)))
        for side, suffix in suffixes.items():
            back = GuardRow(limit - side * given, piece.name, None, "limit", 0)
            kept = (guard._replace(target=guard.target + suffix) for guard in piece.guards)
            every.append(Driven(piece, piece.name + suffix, side * limit, (*kept, back)))
    return tuple(every)


@dataclass(frozen=True)
class Zone:
    """One linear piece of the controller: rows of the voltage, of the PIDF before its notch and of its states'
    derivatives, and its guards."""

    name: str
    voltage: Array
    pidf: Array
    integral: Array
    derivative: Array
    guards: tuple[GuardRow, ...] = ()


def controller_zones(controller: LawNumbers, dead_zone: bool, basis: Basis, error: Array) -> tuple[Zone, ...]:
    """Eq 14 driven by the dead-zone error of Eq 20, gated to zero inside (erratum E16), plus what is always added.

    With `integral_only` the integral stops inside, and the rest goes on.
    """
    # Feedforwards and the offset act inside the dead zone too.
    always = basis.row("feedforward") + basis.row("offset") + basis.row("friction feedforward")
    if "lagging" in basis:
        ahead = basis.row("reference") - basis.row("lagging")
        always = always + controller.velocity_feedforward / controller.velocity_time * ahead
    slope = error - basis.row("derivative")
    pidf = controller.Kp * error + basis.row("integral") + (controller.Kd / controller.Tf) * slope
    if "notch band" in basis:
        # It rings on inside the dead zone too.
        always = always - controller.notch_gain * basis.row("notch band")
    unlimited = always + pidf
    tolerance = basis.row("tolerance")
    # Pure integral action has a tracking time of zero: a thousandth of the filter's stands for it in the flow.
    back_calculation = 1.0 / np.maximum(controller.tracking, controller.Tf * 1e-3)
    zones: list[Zone] = []
    for side in (-1, 1) if dead_zone else (0,):
        name = {-1: "-", 0: "on", 1: "+"}[side]
        guards = (GuardRow(controller.enter * tolerance - side * error, "inside", None, "enter", side),) if side else ()
        linear = Zone(name, unlimited, pidf, controller.Ki * error, slope / controller.Tf, guards)
        zones += _saturated(linear, basis, back_calculation)
    if dead_zone:
        leave = tuple(
            GuardRow(s * error - controller.leave * tolerance, "+" if s > 0 else "-", None, "leave", s) for s in (1, -1)
        )
        zero = np.zeros(len(basis.names))
        if controller.integral_only:
            inside = Zone("inside", unlimited, pidf, zero, slope / controller.Tf, leave)
        else:
            inside = Zone("inside", always, zero, zero, -basis.row("derivative") / controller.Tf, leave)
        zones += _saturated(inside, basis, 0.0) if inside.voltage.any() else [inside]
    return tuple(zones)


def _saturated(zone: Zone, basis: Basis, rate: float | Array) -> list[Zone]:
    """The zone itself and, with a voltage limit, its two saturated zones, with back-calculation at a rate (1/s)."""
    if "voltage limit" not in basis:
        return [zone]
    limit, unlimited = basis.row("voltage limit"), zone.voltage
    ends = saturations(zone.name, unlimited, limit)
    zones = [replace(zone, guards=(*zone.guards, *(end.enter for end in ends)))]
    for end in ends:
        integral = zone.integral + rate * (end.side * limit - unlimited)
        leave = (*zone.guards, end.leave)
        zones.append(Zone(end.enter.target, end.side * limit, zone.pidf, integral, zone.derivative, leave))
    return zones


class Saturation(NamedTuple):
    """One end of the limit of a zone's command: its side, and the guards into it and back."""

    side: int
    enter: GuardRow
    leave: GuardRow


def saturations(zone: str, unlimited: Array, limit: Array) -> tuple[Saturation, ...]:
    """Both ends of the limit of a zone (by name), of the rows (s,) of its command without the limit, and of the limit.

    The zone of an end has the name that the guard into it leads to.
    """
    return tuple(
        Saturation(
            side,
            GuardRow(side * unlimited - limit, zone + suffix, None, "saturate", side),
            GuardRow(limit - side * unlimited, zone, None, "saturate", 0),
        )
        for side, suffix in ((1, " high"), (-1, " low"))
    )
