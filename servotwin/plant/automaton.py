"""The servo as a piecewise-affine automaton: backlash {-, open, +} times controller zone, inputs as exosystem states.

With a continuous controller the zones are dead zone {-, inside, +} times optional saturation {low, linear, high}; with
a sampled one there is a single zone and the voltage is a state that the tick sets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array, Automaton, Guard, Mode
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic

INPUTS = ("reference", "gap", "tolerance")


@dataclass(frozen=True)
class Shape:
    """What decides which states exist: the polynomial degree of each input, whether there is a dead zone and noise."""

    reference: int = 0
    gap: int = 0
    tolerance: int = 0
    dead_zone: bool = True
    noise: bool = False


@dataclass(frozen=True)
class _Play:
    """One mode of the backlash: pressed against the flank of a side, held there at rest, or open (side 0)."""

    name: str
    side: int
    held: bool = False


_RIGID = (_Play("-", -1), _Play("open", 0), _Play("+", 1))
# A load that acts back would push a slow motor off its flank, and nothing would keep it off: between the two it rests
# there under part of the load (the sliding mode of this automaton).
_ELASTIC = (*_RIGID, _Play("held -", -1, held=True), _Play("held +", 1, held=True))
_OPEN = 1


@dataclass(frozen=True)
class _Zone:
    """One linear piece of the controller: rows of the voltage and of its states' derivatives, and guards (row, target
    zone, label, side)."""

    name: str
    voltage: Array
    integral: Array
    derivative: Array
    guards: tuple[tuple[Array, str, str, int], ...] = ()


@dataclass(frozen=True, eq=False)
class ServoAutomaton:
    """The automaton with the rows of its outputs.

    Attributes
    ----------
    rows : dict
        Output name to (M, n) rows: q1..qn, position, theta_m, theta_d, voltage, reference, gap, tolerance, error.
    zones : tuple of str
        Names of the controller's zones; mode = mode of the backlash * len(zones) + zone.
    """

    automaton: Automaton
    rows: dict[str, Array]
    zones: tuple[str, ...]
    opened: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.zones)
        # Where the gap jumps, contact is lost unless the open mode finds it again.
        object.__setattr__(
            self, "opened", tuple(_OPEN * count + mode % count for mode in range(len(self.automaton.modes)))
        )

    def mode(self, zone: str) -> int:
        """The open mode in a zone of the controller."""
        return _OPEN * len(self.zones) + self.zones.index(zone)

    def input_values(self, name: str, coefficients: Array) -> dict[int, float]:
        """States of an input at the start of a cubic piece with ascending `coefficients`: its value and derivatives."""
        factorials = (1.0, 1.0, 2.0, 6.0)
        states = [i for i, state in enumerate(self.automaton.names) if state.split("'")[0] == name]
        return {index: float(factorials[k] * coefficients[k]) for k, index in enumerate(states)}


def degree(pieces: PiecewiseCubic) -> int:
    """Highest power with a coefficient that is not zero in any piece."""
    used = np.flatnonzero(np.any(pieces.coeffs != 0.0, axis=0))
    return int(used[-1]) if used.size else 0


@lru_cache(maxsize=64)
def continuous_loop(servo: Servo, controller: Controller, shape: Shape) -> ServoAutomaton:
    """Plant and law together (Figs 8 and 10a)."""
    names = _plant_names(servo) + ["integral", "derivative"] + (["filtered"] if controller.loop_filter_hz else [])
    names += [name for key in INPUTS for name in _chain_names(key, getattr(shape, key))]
    names += ["voltage limit"] if controller.voltage_limit else []
    names += ["noise"] if shape.noise else []
    basis = _Basis(tuple(names))
    sensed = _position(servo, basis) + basis.row("noise")
    measured = basis.row("filtered") if controller.loop_filter_hz else sensed
    zones = _zones(controller, shape, basis, basis.row("reference") - measured)
    modes = []
    for play in _plays(servo):
        for zone in zones:
            flow = _plant_flow(servo, basis, play, zone.voltage)
            flow[basis["integral"]], flow[basis["derivative"]] = zone.integral, zone.derivative
            if controller.loop_filter_hz:
                rate = 2.0 * np.pi * controller.loop_filter_hz
                flow[basis["filtered"]] = rate * (sensed - basis.row("filtered"))
            modes.append(_mode(servo, basis, flow, play, zone, zones))
    rows = _output_rows(servo, basis, zones)
    rows["error"] = np.tile(basis.row("reference") - measured, (len(modes), 1))
    rows["measured_position"] = np.tile(sensed, (len(modes), 1))
    return ServoAutomaton(Automaton(tuple(modes), basis.names), rows, tuple(zone.name for zone in zones))


@lru_cache(maxsize=64)
def sampled_plant(servo: Servo, gap_degree: int) -> ServoAutomaton:
    """The plant between two ticks: the voltage is held."""
    basis = _Basis((*_plant_names(servo), "voltage", *_chain_names("gap", gap_degree)))
    zero = np.zeros(len(basis.names))
    zones = (_Zone("held", basis.row("voltage"), zero, zero),)
    modes = [
        _mode(servo, basis, _plant_flow(servo, basis, play, basis.row("voltage")), play, zones[0], zones)
        for play in _plays(servo)
    ]
    return ServoAutomaton(Automaton(tuple(modes), basis.names), _output_rows(servo, basis, zones), ("held",))


class _Basis:
    """Names of the states, and unit rows by name."""

    def __init__(self, names: tuple[str, ...]) -> None:
        # Spare states that never move: the kernel's products run over whole vectors of the machine.
        self.names = (*names, *(f"spare{i}" for i in range(-len(names) % 4)))

    def __getitem__(self, name: str) -> int:
        return self.names.index(name)

    def row(self, name: str) -> Array:
        """The row that picks a state; zero when there is no such state."""
        row = np.zeros(len(self.names))
        if name in self.names:
            row[self[name]] = 1.0
        return row


def _plant_names(servo: Servo) -> list[str]:
    return ["current", "speed", "theta_m", "theta_d", *(f"chain{i}" for i in range(servo.chain().A.shape[0]))]


def _chain_names(key: str, order: int) -> list[str]:
    return [key + "'" * k for k in range(order + 1)]


def _position(servo: Servo, basis: _Basis) -> Array:
    return _positions(servo, basis)[-1]


def _positions(servo: Servo, basis: _Basis) -> Array:
    chain = servo.chain()
    first = basis["chain0"]
    rows = np.zeros((servo.n, len(basis.names)))
    rows[:, first : first + chain.A.shape[0]] = chain.C
    rows[:, basis["theta_d"]] += chain.D * servo.p
    return rows


def _plays(servo: Servo) -> tuple[_Play, ...]:
    return _RIGID if servo.rigid else _ELASTIC


def _screw_rate(basis: _Basis, side: int) -> Array:
    """theta_d' of the play operator: with the motor, less the half gap's own rate, in contact; zero in the gap (facts
    E3, E4)."""
    if side == 0:
        return np.zeros(len(basis.names))
    return basis.row("speed") - 0.5 * side * basis.row("gap'")


def _plant_flow(servo: Servo, basis: _Basis, play: _Play, voltage: Array) -> Array:
    """(n, n) flow of motor, screw, chain and input chains in one mode of the backlash; other rows are zero."""
    flow = np.zeros((len(basis.names), len(basis.names)))
    chain, (A, B, E) = servo.chain(), servo.motor()
    size, first, screw = chain.A.shape[0], basis["chain0"], basis["theta_d"]
    states = slice(first, first + size)
    flow[:3, :3] = A
    flow[:3] += np.outer(B, voltage)
    flow[screw] = _screw_rate(basis, 0 if play.held else play.side)
    flow[states, states] = chain.A
    flow[states] += servo.p * (
        np.outer(chain.B_position, basis.row("theta_d")) + np.outer(chain.B_velocity, flow[screw])
    )
    if play.held:
        flow[basis["speed"]] = 0.5 * play.side * basis.row("gap''")
    elif play.side:
        force = chain.reaction_position * servo.p * basis.row("theta_d")
        force[states] += chain.reaction
        flow[:3] -= servo.p * np.outer(E, force)
    for name in basis.names:
        if name + "'" in basis.names:
            flow[basis[name]] = basis.row(name + "'")
    return flow


def _contact_reset(servo: Servo, basis: _Basis, side: int) -> Array:
    """Put the screw on its flank; the chain's damper turns a jump of the screw into one of velocity (Eq 10)."""
    reset = np.eye(len(basis.names))
    moved = basis.row("theta_m") - 0.5 * side * basis.row("gap") - basis.row("theta_d")
    chain = servo.chain()
    reset[basis["theta_d"]] += moved
    first = basis["chain0"]
    reset[first : first + chain.A.shape[0]] += servo.p * np.outer(chain.B_velocity, moved)
    return reset


def _mode(servo: Servo, basis: _Basis, flow: Array, play: _Play, zone: _Zone, zones: tuple[_Zone, ...]) -> Mode:
    zone_names, plays = [z.name for z in zones], _plays(servo)
    here = zone_names.index(zone.name)

    def in_play(name: str) -> int:
        return [p.name for p in plays].index(name) * len(zones) + here

    guards = [
        Guard(row, plays.index(play) * len(zones) + zone_names.index(target), None, label, which)
        for row, target, label, which in zone.guards
    ]
    for row, target, reset, label, which in _play_guards(servo, basis, play, zone.voltage):
        guards.append(Guard(row, in_play(target), reset, label, which))
    return Mode(flow, tuple(guards), f"{play.name}/{zone.name}")


_PlayGuard = tuple[Array, str, Array | None, str, int]


def _play_guards(servo: Servo, basis: _Basis, play: _Play, voltage: Array) -> list[_PlayGuard]:
    """What ends a mode of the backlash: (row, mode entered, reset, label, side)."""
    side = play.side
    if side == 0:
        apart = basis.row("theta_m") - basis.row("theta_d")
        return [
            (s * apart - 0.5 * basis.row("gap"), "+" if s > 0 else "-", _contact_reset(servo, basis, s), "contact", s)
            for s in (1, -1)
        ]
    flank = "+" if side > 0 else "-"
    if play.held:
        # Accelerations away from the flank's own: free of the load, and under all of it.
        free, pressed = (
            side * _plant_flow(servo, basis, _Play("", s), voltage)[basis["speed"]] - 0.5 * basis.row("gap''")
            for s in (0, side)
        )
        return [(pressed, flank, None, "contact", side), (-free, "open", None, "release", side)]
    reset = _contact_reset(servo, basis, side)
    release = -side * _screw_rate(basis, side)
    if servo.rigid:
        return [(release, "open", reset, "release", side)]
    reset[basis["speed"]] = 0.5 * side * basis.row("gap'")
    return [(release, f"held {flank}", reset, "hold", side)]


def _zones(controller: Controller, shape: Shape, basis: _Basis, error: Array) -> tuple[_Zone, ...]:
    """The controller's linear pieces: Eq 14 driven by the dead-zone error of Eq 20, gated to zero inside (facts
    E16)."""
    zero = np.zeros(len(basis.names))
    slope = error - basis.row("derivative")
    wanted = controller.Kp * error + basis.row("integral") + (controller.Kd / controller.Tf) * slope
    tolerance = basis.row("tolerance")
    zones: list[_Zone] = []
    for side in (-1, 1) if shape.dead_zone else (0,):
        name = {-1: "-", 0: "on", 1: "+"}[side]
        guards = ((controller.enter * tolerance - side * error, "inside", "enter", side),) if side else ()
        zones += _saturated(controller, basis, name, wanted, controller.Ki * error, slope / controller.Tf, guards)
    if shape.dead_zone:
        leave = tuple((s * error - controller.leave * tolerance, "+" if s > 0 else "-", "leave", s) for s in (1, -1))
        zones.append(_Zone("inside", zero, zero, -basis.row("derivative") / controller.Tf, leave))
    return tuple(zones)


def _saturated(
    controller: Controller,
    basis: _Basis,
    name: str,
    wanted: Array,
    integral: Array,
    derivative: Array,
    guards: tuple[tuple[Array, str, str, int], ...],
) -> list[_Zone]:
    """A linear zone, and with a voltage limit its two saturated ones with back-calculation."""
    if controller.voltage_limit is None:
        return [_Zone(name, wanted, integral, derivative, guards)]
    limit = basis.row("voltage limit")
    linear = (
        *guards,
        (wanted - limit, name + " high", "saturate", 1),
        (-wanted - limit, name + " low", "saturate", -1),
    )
    zones = [_Zone(name, wanted, integral, derivative, linear)]
    for side, suffix in ((1, " high"), (-1, " low")):
        back = (side * limit - wanted) / max(controller.tracking, controller.Tf * 1e-3)
        leave = (*guards, (limit - side * wanted, name, "saturate", 0))
        zones.append(_Zone(name + suffix, side * limit, integral + back, derivative, leave))
    return zones


def _output_rows(servo: Servo, basis: _Basis, zones: tuple[_Zone, ...]) -> dict[str, Array]:
    count = len(_plays(servo)) * len(zones)
    rows = {f"q{i + 1}": row for i, row in enumerate(_positions(servo, basis))}
    rows |= {"position": _position(servo, basis)}
    rows |= {name: basis.row(name) for name in ("theta_m", "theta_d", "reference", "gap", "tolerance")}
    full = {name: np.tile(row, (count, 1)) for name, row in rows.items()}
    full["voltage"] = np.tile([zone.voltage for zone in zones], (len(_plays(servo)), 1))
    return full
