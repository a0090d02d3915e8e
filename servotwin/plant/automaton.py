"""The servo as a piecewise-affine automaton: contact times stick-slip times controller zone.

Inputs are exosystem states.

With a continuous controller the zones are dead zone {-, inside, +} times optional saturation {low, linear, high}; with
a sampled one there is a single zone and the voltage is a state that the tick sets. Friction modes and the states of
constant disturbances exist only where the `Shape` requests them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Generic

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array, Automaton, AutomatonStack, Guard, Mode
from servotwin.plant.backlash import (
    OPEN,
    ContactMode,
    contact_guards,
    contact_modes,
    contact_reset,
    flank,
    screw_force,
    screw_rate,
)
from servotwin.plant.basis import (
    BacklashKind,
    Basis,
    GuardRow,
    LawNumbers,
    PlantNumbers,
    input_names,
    plant_names,
)
from servotwin.plant.flow import mechanical_flow
from servotwin.plant.friction import (
    SMOOTH,
    FrictionState,
    StickSlipMode,
    load_guards,
    motor_guards,
    stick_slip_modes,
)
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.plant.zones import Driven, Piece, Zone, controller_zones, driven_pieces

INPUTS = ("reference", "gap", "tolerance")
_APART = ContactMode("", 0)


@dataclass(frozen=True)
class Shape:
    """Switches and degrees that decide which states and modes exist.

    Parameters
    ----------
    reference, gap, tolerance : int
        Polynomial degree of each input.
    dead_zone, noise : bool
        True for the zones of a dead zone, and for a state "noise" (m, on the measurement).
    bias : bool
        A state "input bias" (V, added to the voltage behind the controller).
    friction : bool
        A state "friction" (N m, Coulomb's on the motor's shaft) and the modes of stick and slip.
    feedforward, offset : bool
        States of those names (V, always added to the controller's voltage); the offset decays.
    friction_feedforward : bool
        A state "friction feedforward" (V, always added), with the sign of the reference's last change.
    """

    reference: int = 0
    gap: int = 0
    tolerance: int = 0
    dead_zone: bool = True
    noise: bool = False
    bias: bool = False
    friction: bool = False
    feedforward: bool = False
    offset: bool = False
    friction_feedforward: bool = False


@dataclass(frozen=True, eq=False)
class ServoAutomaton:
    """The automaton with the rows of its outputs.

    Attributes
    ----------
    rows : dict
        Output name to (M, n) rows: q1..qn, position, theta_m, theta_d, voltage, reference, gap, tolerance, error.
    zones : tuple of str
        Names of the controller's zones.
    frictions : int
        Number of stick-slip modes, the first at rest; mode = (contact mode * frictions + stick-slip mode) * len(zones)
        + zone.
    opened : tuple of int
        For each mode the open mode with the same stick-slip mode and zone.
    """

    automaton: Automaton
    rows: dict[str, Array]
    zones: tuple[str, ...]
    frictions: int = 1
    opened: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        count = self.frictions * len(self.zones)
        # Where the gap jumps, contact is lost unless the open mode finds it again.
        object.__setattr__(
            self, "opened", tuple(OPEN * count + mode % count for mode in range(len(self.automaton.modes)))
        )

    def mode(self, zone: str, side: int = 0) -> int:
        """The open mode, or that on the flank of a side, the motor at rest, in a zone of the controller."""
        return (OPEN + side) * self.modes_per_contact + self.zones.index(zone)

    @property
    def modes_per_contact(self) -> int:
        """Number of modes of each contact mode."""
        return self.frictions * len(self.zones)

    def input_values(self, name: str, coefficients: Array) -> dict[int, float]:
        """States of an input at the start of a cubic piece with ascending `coefficients`: its value and derivatives."""
        factorials = (1.0, 1.0, 2.0, 6.0)
        states = [i for i, state in enumerate(self.automaton.names) if state.split("'")[0] == name]
        return {index: float(factorials[k] * coefficients[k]) for k, index in enumerate(states)}


@dataclass(frozen=True, eq=False)
class LoopParts:
    """Parts of an automaton, or on leading axes of many with one structure.

    Attributes
    ----------
    states, modes : sequence of str
        Names.
    flows : list of M (..., N, N) arrays
    guards : list of M tuples of Guard
        Rows (..., N), resets (..., N, N).
    rows : dict of (..., M, N) arrays
    zones : tuple of str
    frictions : int
    """

    states: tuple[str, ...]
    modes: list[str]
    flows: list[Array]
    guards: list[tuple[Guard, ...]]
    rows: dict[str, Array]
    zones: tuple[str, ...]
    frictions: int

    def assembled(self) -> ServoAutomaton:
        """The automaton of parts without leading axes."""
        modes = tuple(Mode(*mode) for mode in zip(self.flows, self.guards, self.modes, strict=True))
        return ServoAutomaton(Automaton(modes, self.states), self.rows, self.zones, self.frictions)

    def stacked(self, count: int) -> tuple[ServoAutomaton, AutomatonStack, dict[str, Array]]:
        """The first automaton, the numbers of all `count` of them, and the rows of their outputs."""
        n, most = len(self.states), max(1, *(len(guards) for guards in self.guards))
        shape = count, len(self.modes)
        # Resets of modes are mostly those of all plants.
        every = [guard.reset for guards in self.guards for guard in guards if guard.reset is not None]
        different = count if any(np.ndim(reset) > 2 for reset in every) else 1
        flows, rows = np.zeros((*shape, n, n)), np.zeros((*shape, most, n))
        resets = np.zeros((different, len(self.modes), most, n, n))
        for m, (flow, guards) in enumerate(zip(self.flows, self.guards, strict=True)):
            flows[:, m] = flow
            for g, guard in enumerate(guards):
                rows[:, m, g] = guard.row
                if guard.reset is not None:
                    resets[:, m, g] = guard.reset
        outputs = {name: np.broadcast_to(row, (count, *row.shape[-2:])) for name, row in self.rows.items()}
        modes = tuple(
            Mode(flows[0, m], tuple(_with(each, rows[0, m, g], resets[0, m, g]) for g, each in enumerate(guards)), name)
            for m, (guards, name) in enumerate(zip(self.guards, self.modes, strict=True))
        )
        first = ServoAutomaton(
            Automaton(modes, self.states), {name: row[0] for name, row in outputs.items()}, self.zones, self.frictions
        )
        return first, AutomatonStack(first.automaton, flows, rows, resets), outputs


def _with(guard: Guard, row: Array, reset: Array) -> Guard:
    return Guard(row, guard.target, None if guard.reset is None else reset, guard.label, guard.side)


def degree(pieces: PiecewiseCubic) -> int:
    """Highest power with a coefficient that is not zero in any piece."""
    used = np.flatnonzero(np.any(pieces.coeffs != 0.0, axis=0))
    return int(used[-1]) if used.size else 0


def continuous_loop(servo: Plant, controller: Controller, shape: Shape) -> ServoAutomaton:
    """Plant and law together (Figs 8 and 10a); one automaton for controllers that differ in constant feedforwards
    only."""
    return _one_continuous_loop(servo, without_feedforward(controller), shape)


def without_feedforward(controller: Controller) -> Controller:
    """Controller without the feedforwards that the automaton holds as states: equal ones share an automaton."""
    if not (controller.feedforward or controller.friction_feedforward):
        return controller
    return controller.replace(feedforward=0.0, friction_feedforward=0.0)


@lru_cache(maxsize=64)
def _one_continuous_loop(servo: Plant, controller: Controller, shape: Shape) -> ServoAutomaton:
    return continuous_parts(servo, controller, shape).assembled()


def continuous_parts(servo: PlantNumbers, controller: LawNumbers, shape: Shape) -> LoopParts:
    """Modes, guards and outputs of plants and laws together."""
    basis = Basis(tuple(_loop_names(servo, controller, shape)))
    sensed = basis.sensed(servo) + basis.row("noise")
    measured = sensed if controller.loop_filter_hz is None else basis.row("filtered")
    error = basis.row("reference") - measured
    system = LoopModes(servo, basis, controller_zones(controller, shape.dead_zone, basis, error), shape.friction)
    flows = []
    for contact, stick_slip, driven in system.combinations:
        flow = mechanical_flow(servo, basis, contact, stick_slip, driven.command)
        zone = driven.piece
        flow[..., basis["integral"], :], flow[..., basis["derivative"], :] = zone.integral, zone.derivative
        if controller.loop_filter_hz is not None:
            rate = 2.0 * np.pi * controller.loop_filter_hz
            flow[..., basis["filtered"], :] = rate * (sensed - basis.row("filtered"))
        if "lagging" in basis:
            flow[..., basis["lagging"], :] = (basis.row("reference") - basis.row("lagging")) / controller.velocity_time
        if "notch band" in basis:
            omega = 2.0 * np.pi * controller.notch_hz
            band, low = basis.row("notch band"), basis.row("notch low")
            flow[..., basis["notch band"], :] = omega * (zone.pidf - low - 2.0 * controller.notch_damping * band)
            flow[..., basis["notch low"], :] = omega * band
        if shape.offset:
            flow[..., basis["offset"], :] = -basis.row("offset") / controller.release
        flows.append(flow)
    return system.parts(flows, error=error, measured_position=sensed)


@lru_cache(maxsize=64)
def sampled_plant(servo: Plant, gap_degree: int, bias: bool = False, friction: bool = False) -> ServoAutomaton:
    """The plant between two ticks, under a constant voltage (zero-order hold)."""
    return sampled_parts(servo, gap_degree, bias, friction).assembled()


def sampled_parts(servo: PlantNumbers, gap_degree: int, bias: bool, friction: bool) -> LoopParts:
    """Modes, guards and outputs of plants under a constant voltage."""
    names = [*plant_names(servo), "voltage", *input_names("gap", gap_degree), *constants(servo, bias, friction)]
    # The tick reads one state: a measurement that none of them is becomes one.
    names += ["sensed"] if servo.at_motor or servo.chain().D[-1] else []
    basis = Basis(tuple(names))
    zero = np.zeros(len(basis.names))
    system = LoopModes(servo, basis, (Zone("held", basis.row("voltage"), zero, zero, zero),), friction)
    return system.parts(
        [
            mechanical_flow(servo, basis, contact, stick_slip, driven.command)
            for contact, stick_slip, driven in system.combinations
        ]
    )


def _loop_names(servo: PlantNumbers, controller: LawNumbers, shape: Shape) -> list[str]:
    names = (
        plant_names(servo)
        + ["integral", "derivative"]
        + (["filtered"] if controller.loop_filter_hz is not None else [])
        + (["lagging"] if np.any(controller.velocity_feedforward) else [])
        + (["notch band", "notch low"] if np.any(controller.notch_hz) else [])
    )
    names += [name for key in INPUTS for name in input_names(key, getattr(shape, key))]
    names += ["voltage limit"] if controller.voltage_limit is not None else []
    names += ["noise"] if shape.noise else []
    names += [name for name in ("feedforward", "offset") if getattr(shape, name)]
    names += ["friction feedforward"] if shape.friction_feedforward else []
    return names + constants(servo, shape.bias, shape.friction)


def constants(servo: PlantNumbers, bias: bool, friction: bool) -> list[str]:
    """States of a plant that never change."""
    guide = servo.guide
    falls, load_falls = (bool(np.any(each.slope)) for each in (servo.motor_stribeck, guide.stribeck))
    present = {
        "input bias": bias,
        "drive limit": servo.command_limit is not None,
        "friction": friction,
        "friction drop": friction and falls,
        "friction stribeck": friction and falls,
        "load force": guide.force != 0.0,
        "load friction": guide.friction != 0.0,
        "load friction drop": load_falls,
        "load friction stribeck": load_falls,
    }
    return [name for name, there in present.items() if there]


class LoopModes(Generic[Piece]):
    """All combinations of contact mode, stick-slip mode and zone, in the order of the automaton's modes."""

    def __init__(self, servo: PlantNumbers, basis: Basis, zones: Sequence[Piece], friction: bool) -> None:
        self.servo, self.basis, self.zones = servo, basis, driven_pieces(zones, basis)
        self.contacts, self.frictions = contact_modes(servo), stick_slip_modes(servo, friction)
        self._resets = {side: contact_reset(servo, basis, side) for side in (-1, 1)}
        self.combinations = [
            (contact, stick_slip, zone)
            for contact in self.contacts
            for stick_slip in self.frictions
            for zone in self.zones
        ]
        self.names = [(contact.name, stick_slip.name, zone.name) for contact, stick_slip, zone in self.combinations]

    def parts(self, flows: list[Array], **rows: Array) -> LoopParts:
        """Everything with these flows, and `rows` among its outputs."""
        guards = [self._guards(*combination) for combination in self.combinations]
        names = ["/".join(filter(None, name)) for name in self.names]
        outputs = self._outputs() | {name: self._everywhere(row) for name, row in rows.items()}
        zones = tuple(zone.name for zone in self.zones)
        return LoopParts(self.basis.names, names, flows, guards, outputs, zones, len(self.frictions))

    def _everywhere(self, row: Array) -> Array:
        """(..., M, N) rows, the same in every mode."""
        return np.repeat(row[..., None, :], len(self.combinations), axis=-2)

    def _guards(self, contact: ContactMode, stick_slip: StickSlipMode, zone: Driven[Piece]) -> tuple[Guard, ...]:
        ends = [(guard, (contact.name, stick_slip.name, guard.target)) for guard in zone.guards]
        # Friction first: where the motor stops on a flank, the screw stays in contact.
        for guard in self._motor_guards(contact, stick_slip, zone):
            pushes = contact.resting and stick_slip.motor.stuck and guard.side == contact.side
            ends.append((guard, (flank(contact.side) if pushes else contact.name, guard.target, zone.name)))
        ends += [
            (guard, (contact.name, guard.target, zone.name)) for guard in self._load_guards(contact, stick_slip, zone)
        ]
        ends += [
            (guard, (guard.target, stick_slip.name, zone.name))
            for guard in self._contact_guards(contact, stick_slip, zone)
        ]
        return tuple(
            Guard(guard.row, self.names.index(target), guard.reset, guard.label, guard.side) for guard, target in ends
        )

    def _contact_guards(self, contact: ContactMode, stick_slip: StickSlipMode, zone: Driven[Piece]) -> list[GuardRow]:
        accelerations: list[Array] = []
        if contact.resting and not stick_slip.motor.stuck:
            accelerations = [self._acceleration(side, stick_slip.motor, zone) for side in (0, contact.side)]
        return contact_guards(self.servo, self.basis, contact, stick_slip, accelerations, self._resets)

    def _motor_guards(self, contact: ContactMode, stick_slip: StickSlipMode, zone: Driven[Piece]) -> list[GuardRow]:
        if stick_slip.motor is SMOOTH:
            return []
        torques = dict.fromkeys((1, -1), self._torque(contact, zone))
        if contact.resting:
            # It goes on against all of the load, and leaves its flank without it.
            torques[-contact.side] = self._torque(_APART, zone)
        return motor_guards(self.servo, self.basis, stick_slip, torques)

    def _load_guards(self, contact: ContactMode, stick_slip: StickSlipMode, zone: Driven[Piece]) -> list[GuardRow]:
        if stick_slip.load is SMOOTH:
            return []
        force = np.zeros(len(self.basis.names))
        if stick_slip.load.stuck:
            sliding = replace(stick_slip, load=SMOOTH)
            flow = mechanical_flow(self.servo, self.basis, contact, sliding, zone.command)
            force = self.servo.guide.mass * flow[..., self.basis.last_speed(self.servo), :]
        return load_guards(self.servo, self.basis, stick_slip, force)

    def _torque(self, contact: ContactMode, zone: Driven[Piece]) -> Array:
        """Row of the torque that drives the motor's shaft against its friction, N m."""
        shaft, basis = self.servo.shaft(), self.basis
        lead = shaft.torque.shape[:-1]
        torque = np.zeros((*lead, len(basis.names)))
        torque[..., : shaft.torque.shape[-1]] = shaft.torque
        if np.any(shaft.direct):
            torque = torque + shaft.direct * zone.command
        if self.servo.backlash_kind is not BacklashKind.RIGID and contact.side:
            torque = torque - self.servo.p * screw_force(self.servo, basis, screw_rate(self.servo, basis, contact))
        return np.asarray(torque)

    def _acceleration(self, side: int, motor: FrictionState, zone: Driven[Piece]) -> Array:
        """The motor's acceleration in contact with a flank, or without contact (side 0), its load not stuck."""
        flow = mechanical_flow(
            self.servo, self.basis, ContactMode("", side), StickSlipMode(motor, SMOOTH), zone.command
        )
        return np.asarray(flow[..., self.basis["speed"], :])

    def _outputs(self) -> dict[str, Array]:
        positions = self.basis.positions(self.servo)
        rows = {f"q{i + 1}": positions[..., i, :] for i in range(self.servo.n)}
        rows |= {"position": rows[f"q{self.servo.n}"], "sensed": self.basis.sensed(self.servo)}
        rows |= {name: self.basis.row(name) for name in ("theta_m", "theta_d", "reference", "gap", "tolerance")}
        full = {name: self._everywhere(row) for name, row in rows.items()}
        full["voltage"] = np.stack(
            np.broadcast_arrays(*(zone.piece.voltage for _, _, zone in self.combinations)), axis=-2
        )
        return full
