"""The servo as a piecewise-affine automaton: backlash times friction times controller zone, inputs as exosystem states.

With a continuous controller the zones are dead zone {-, inside, +} times optional saturation {low, linear, high}; with
a sampled one there is a single zone and the voltage is a state that the tick sets. Friction modes, and the states of
what is constant, exist only where they are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array, Automaton, Guard, Mode
from servotwin.plant.basis import Basis, input_names, plant_names
from servotwin.plant.mechanics import OPEN, Grip, Play, flow_of, grip_endings, grips, play_endings, plays
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic
from servotwin.plant.zones import Zone, controller_zones

INPUTS = ("reference", "gap", "tolerance")


@dataclass(frozen=True)
class Shape:
    """What decides which states and modes exist.

    Parameters
    ----------
    reference, gap, tolerance : int
        Polynomial degree of each input.
    dead_zone, noise : bool
        Whether there are zones for the dead zone, and a state "noise" (m, on the measurement).
    bias : bool
        A state "input bias" (V, added to the voltage behind the controller).
    friction : bool
        A state "friction" (N m, Coulomb's on the motor's shaft) and the modes of stick and slip.
    feedforward, offset : bool
        States of those names (V, always added to the controller's voltage); the offset decays.
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


@dataclass(frozen=True, eq=False)
class ServoAutomaton:
    """The automaton with the rows of its outputs.

    Attributes
    ----------
    rows : dict
        Output name to (M, n) rows: q1..qn, position, theta_m, theta_d, voltage, reference, gap, tolerance, error.
    zones : tuple of str
        Names of the controller's zones.
    grips : int
        Number of modes of the friction, the first at rest; mode = (mode of the backlash * grips + mode of the friction)
        * len(zones) + zone.
    """

    automaton: Automaton
    rows: dict[str, Array]
    zones: tuple[str, ...]
    grips: int = 1
    opened: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        count = self.grips * len(self.zones)
        # Where the gap jumps, contact is lost unless the open mode finds it again.
        object.__setattr__(
            self, "opened", tuple(OPEN * count + mode % count for mode in range(len(self.automaton.modes)))
        )

    def mode(self, zone: str) -> int:
        """The open mode, the motor at rest, in a zone of the controller."""
        return OPEN * self.grips * len(self.zones) + self.zones.index(zone)

    def input_values(self, name: str, coefficients: Array) -> dict[int, float]:
        """States of an input at the start of a cubic piece with ascending `coefficients`: its value and derivatives."""
        factorials = (1.0, 1.0, 2.0, 6.0)
        states = [i for i, state in enumerate(self.automaton.names) if state.split("'")[0] == name]
        return {index: float(factorials[k] * coefficients[k]) for k, index in enumerate(states)}


def degree(pieces: PiecewiseCubic) -> int:
    """Highest power with a coefficient that is not zero in any piece."""
    used = np.flatnonzero(np.any(pieces.coeffs != 0.0, axis=0))
    return int(used[-1]) if used.size else 0


def continuous_loop(servo: Servo, controller: Controller, shape: Shape) -> ServoAutomaton:
    """Plant and law together (Figs 8 and 10a); one automaton for controllers that differ in the feedforward only."""
    return _continuous_loop(servo, without_feedforward(controller), shape)


def without_feedforward(controller: Controller) -> Controller:
    """The same controller as far as the automaton's numbers go: the feedforward is a state."""
    return controller.replace(feedforward=0.0) if controller.feedforward else controller


@lru_cache(maxsize=64)
def _continuous_loop(servo: Servo, controller: Controller, shape: Shape) -> ServoAutomaton:
    basis = Basis(tuple(_loop_names(servo, controller, shape)))
    sensed = basis.positions(servo)[-1] + basis.row("noise")
    measured = basis.row("filtered") if controller.loop_filter_hz else sensed
    error = basis.row("reference") - measured
    system = _System(servo, basis, controller_zones(controller, shape.dead_zone, basis, error), shape.friction)
    flows = []
    for play, grip, zone in system.places:
        flow = flow_of(servo, basis, play, grip, zone.voltage)
        flow[basis["integral"]], flow[basis["derivative"]] = zone.integral, zone.derivative
        if controller.loop_filter_hz:
            rate = 2.0 * np.pi * controller.loop_filter_hz
            flow[basis["filtered"]] = rate * (sensed - basis.row("filtered"))
        if shape.offset:
            flow[basis["offset"]] = -basis.row("offset") / controller.release_time
        flows.append(flow)
    return system.assembled(flows, error=error, measured_position=sensed)


@lru_cache(maxsize=64)
def sampled_plant(servo: Servo, gap_degree: int, bias: bool = False, friction: bool = False) -> ServoAutomaton:
    """The plant between two ticks: the voltage is held."""
    names = [*plant_names(servo), "voltage", *input_names("gap", gap_degree), *_constants(bias, friction)]
    basis = Basis(tuple(names))
    zero = np.zeros(len(basis.names))
    system = _System(servo, basis, (Zone("held", basis.row("voltage"), zero, zero),), friction)
    return system.assembled([flow_of(servo, basis, play, grip, zone.voltage) for play, grip, zone in system.places])


def _loop_names(servo: Servo, controller: Controller, shape: Shape) -> list[str]:
    names = plant_names(servo) + ["integral", "derivative"] + (["filtered"] if controller.loop_filter_hz else [])
    names += [name for key in INPUTS for name in input_names(key, getattr(shape, key))]
    names += ["voltage limit"] if controller.voltage_limit else []
    names += ["noise"] if shape.noise else []
    names += [name for name in ("feedforward", "offset") if getattr(shape, name)]
    return names + _constants(shape.bias, shape.friction)


def _constants(bias: bool, friction: bool) -> list[str]:
    return (["input bias"] if bias else []) + (["friction"] if friction else [])


class _System:
    """Every combination of backlash, friction and zone, in the order of the modes."""

    def __init__(self, servo: Servo, basis: Basis, zones: tuple[Zone, ...], friction: bool) -> None:
        self.servo, self.basis, self.zones = servo, basis, zones
        self.plays, self.grips = plays(servo), grips(servo, friction)
        self.places = [(play, grip, zone) for play in self.plays for grip in self.grips for zone in zones]
        self.names = [(play.name, grip.name, zone.name) for play, grip, zone in self.places]

    def assembled(self, flows: list[Array], **rows: Array) -> ServoAutomaton:
        """The automaton with these flows, and `rows` among its outputs."""
        modes = tuple(
            Mode(flow, self._guards(*place), "/".join(filter(None, names)))
            for flow, place, names in zip(flows, self.places, self.names, strict=True)
        )
        outputs = self._outputs() | {name: np.tile(row, (len(modes), 1)) for name, row in rows.items()}
        names = tuple(zone.name for zone in self.zones)
        return ServoAutomaton(Automaton(modes, self.basis.names), outputs, names, len(self.grips))

    def _guards(self, play: Play, grip: Grip, zone: Zone) -> tuple[Guard, ...]:
        found = [
            Guard(row, self.names.index((play.name, grip.name, target)), None, label, side)
            for row, target, label, side in zone.guards
        ]
        # Friction first: where the motor stops on a flank, the screw stays in contact.
        found += [
            Guard(row, self.names.index((play.name, target, zone.name)), reset, label, side)
            for row, target, reset, label, side in grip_endings(self.servo, self.basis, grip)
        ]
        found += [
            Guard(row, self.names.index((target, grip.name, zone.name)), reset, label, side)
            for row, target, reset, label, side in play_endings(self.servo, self.basis, play, grip, zone.voltage)
        ]
        return tuple(found)

    def _outputs(self) -> dict[str, Array]:
        rows = {f"q{i + 1}": row for i, row in enumerate(self.basis.positions(self.servo))}
        rows |= {"position": rows[f"q{self.servo.n}"]}
        rows |= {name: self.basis.row(name) for name in ("theta_m", "theta_d", "reference", "gap", "tolerance")}
        full = {name: np.tile(row, (len(self.places), 1)) for name, row in rows.items()}
        full["voltage"] = np.array([zone.voltage for _, _, zone in self.places])
        return full
