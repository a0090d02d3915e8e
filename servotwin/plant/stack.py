"""Many servos and controllers as arrays, and their automata at once: one by one they take longer than their runs.

Every number has a leading axis, that of the servos; those that multiply rows are columns (P, 1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import AutomatonStack
from servotwin.plant.actuator import ShaftMatrices, stacked
from servotwin.plant.automaton import ServoAutomaton, Shape, continuous_parts, sampled_parts
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind, Stribeck
from servotwin.plant.changes import PerMass
from servotwin.plant.motor import Motor
from servotwin.plant.plants import Plant
from servotwin.plant.rest import Rest
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain, chain

_FEW = 8  # servos of a stack that is kept


class LoopStack(NamedTuple):
    """Automata of many servos.

    Attributes
    ----------
    plants : PlantStack
    first : ServoAutomaton
        The automaton of the first servo, whose structure all have.
    automata : AutomatonStack
    rows : dict of (P, M, n) arrays
        Outputs of each.
    """

    plants: PlantStack
    first: ServoAutomaton
    automata: AutomatonStack
    rows: dict[str, Array]


class PlantStack:
    """Numbers of servos that have one structure: the number of masses, and a rigid or an elastic screw."""

    def __init__(self, servos: Sequence[Plant]) -> None:
        self.count, self.n, self.backlash_kind = len(servos), servos[0].n, servos[0].backlash_kind
        self.at_motor, self.guide = servos[0].at_motor, servos[0].guide
        self.command_limit = servos[0].command_limit
        self.motor_stribeck = _stacked_stribeck([each.motor_stribeck for each in servos])
        self.p = _column(servos, "p")
        self._axes = [each for each in servos if isinstance(each, Axis)]
        if self._axes:
            self._stack_axes(self._axes)
        else:
            self._stack_servos([each for each in servos if isinstance(each, Servo)])

    def _stack_servos(self, servos: Sequence[Servo]) -> None:
        m, k, c = (
            np.array([_spread(getattr(servo, name), self.n) for servo in servos], dtype=float)
            for name in ("m", "k", "c")
        )
        rigid = self.backlash_kind is BacklashKind.RIGID
        self._chain = chain(m, k, c, math.inf if rigid else np.array([servo.k_d for servo in servos]))
        self._shaft = Motor(*(np.array([getattr(servo, name) for servo in servos]) for name in Motor._fields)).shaft()

    def _stack_axes(self, axes: Sequence[Axis]) -> None:
        m, k, c = (np.array([getattr(axis.load, name) for axis in axes]) for name in ("m", "k", "c"))
        k_d, c_d = (np.array([getattr(axis.transmission, name) for axis in axes]) for name in ("k_d", "c_d"))
        rigid = self.backlash_kind is BacklashKind.RIGID
        self._chain = chain(m, k, c, math.inf if rigid else k_d, 0.0 if rigid or not c_d.any() else c_d)
        self._shaft = stacked([axis.shaft() for axis in axes])
        if axes[0].guide.friction or axes[0].guide.force:
            guides = [axis.guide for axis in axes]
            mass, yielding = (np.array([[getattr(guide, name)] for guide in guides]) for name in ("mass", "yielding"))
            stribeck = _stacked_stribeck([guide.stribeck for guide in guides])
            self.guide = guides[0]._replace(mass=mass, yielding=yielding, stribeck=stribeck)

    def at_rest(self) -> tuple[Array, Array]:
        """(P,) angles and (P, N) states of the structures at rest, per angle of the screw's start."""
        if self._axes:
            every = [axis.at_rest(1.0) for axis in self._axes]
            return np.array([angle for angle, _ in every]), np.array([state for _, state in every])
        return np.ones(self.count), self._chain.equilibrium(self.p)

    def rest_under_force(self, which: int, gap: float, screw: float) -> Rest | None:
        """Position at which the load of one of them hangs."""
        return self._axes[which].rest_under_force(gap, screw) if self._axes else None

    def chain(self) -> Chain:
        """Matrices of the structures."""
        return self._chain

    def shaft(self) -> ShaftMatrices:
        """Matrices of the motors."""
        return self._shaft


@dataclass(frozen=True, eq=False)
class LawStack:
    """Numbers of continuous controllers that have the same limits and filters, (P, 1) arrays."""

    Kp: Array
    Ki: Array
    Kd: Array
    Tf: Array
    enter: Array
    leave: Array
    tracking: Array
    release: Array
    velocity_feedforward: Array
    velocity_time: Array
    notch_hz: Array
    notch_damping: Array
    notch_gain: Array
    loop_filter_hz: Array | None
    voltage_limit: Array | None
    integral_only: bool

    @classmethod
    def of(cls, laws: Sequence[Controller]) -> LawStack:
        """Numbers of controllers."""
        names = ["Kp", "Ki", "Kd", "Tf", "enter", "leave", "tracking", "release"]
        names += ["velocity_feedforward", "velocity_time", "notch_hz", "notch_damping", "notch_gain"]
        optional = ("loop_filter_hz", "voltage_limit")
        columns: dict[str, Any] = {name: _column(laws, name) for name in names}
        columns |= {name: None if getattr(laws[0], name) is None else _column(laws, name) for name in optional}
        return cls(**columns, integral_only=laws[0].integral_only)


def continuous_loops(servos: Sequence[Plant], laws: Sequence[Controller], shape: Shape) -> LoopStack:
    """Automata of servos, each with its continuous controller.

    Parameters
    ----------
    servos, laws : sequences of equal length
        Of one structure.
    shape : Shape
    """
    plants = PlantStack(servos)
    return LoopStack(plants, *continuous_parts(plants, LawStack.of(laws), shape).stacked(plants.count))


def sampled_plants(servos: Sequence[Plant], gap_degree: int, bias: bool, friction: bool) -> LoopStack:
    """Automata of servos of one structure under a constant voltage."""
    # A search simulates hundreds of controllers on the same few machines; larger stacks take up to 50 MB.
    build = _few_sampled_plants if len(servos) <= _FEW else _sampled_plants
    return build(tuple(servos), gap_degree, bias, friction)


def _sampled_plants(servos: tuple[Plant, ...], gap_degree: int, bias: bool, friction: bool) -> LoopStack:
    plants = PlantStack(servos)
    return LoopStack(plants, *sampled_parts(plants, gap_degree, bias, friction).stacked(plants.count))


_few_sampled_plants = lru_cache(maxsize=8)(_sampled_plants)


def _column(items: Sequence[Plant] | Sequence[Controller], name: str) -> Array:
    return np.array([[getattr(item, name)] for item in items], dtype=float)


def _stacked_stribeck(every: Sequence[Stribeck]) -> Stribeck:
    """Friction that falls, with the slopes of many plants; of none its own zero."""
    slopes = np.array([[each.slope] for each in every], dtype=float)
    return every[0]._replace(slope=slopes) if slopes.any() else every[0]


def _spread(value: PerMass, count: int) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * count
