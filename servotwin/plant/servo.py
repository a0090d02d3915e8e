"""The whole servo as one frozen description: motor, screw, chain of masses, sensors, default controller."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Unpack

import numpy as np

from servotwin.config.keys import check, items_of, key, settings
from servotwin.config.table import Table, did_you_mean, named, parse_toml, read_toml
from servotwin.config.toml import dumps, read, values_of
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, filtered_pid
from servotwin.errors import InvalidInput
from servotwin.plant import loop
from servotwin.plant.actuator import ShaftMatrices
from servotwin.plant.basis import BacklashKind, Guide, Stribeck
from servotwin.plant.changes import PerMass, ServoChanges, refuse_unknown
from servotwin.plant.interop import Control
from servotwin.plant.linear import LinearSystem
from servotwin.plant.margins import Margins, margins
from servotwin.plant.motor import Motor
from servotwin.plant.numbers import tolerance_of
from servotwin.plant.release import released
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import LARGEST_GAP, Array
from servotwin.plant.structure import Chain, Structure, chain
from servotwin.runtime.notebook import html_table

_PLANT = (
    "J", "L", "R", "k_T", "k_B", "p", "k_d", "n", "m", "k", "c", "encoder_resolution", "position_resolution",
)  # fmt: skip
"""The plant's numbers in the order of the file, of which `Servo.version` is the hash."""
PRESETS = ("paper", "table1", "paper-gain2")
_CONTROLLER_FIELDS = tuple(field.name for field in dataclasses.fields(Controller))


@settings("servo")
@dataclass(frozen=True, repr=False)
class Servo:
    """A position servo: DC motor, lead screw, chain of n masses, sensors and its default controller.

    Raises
    ------
    InvalidInput
        A value is not a finite number in its range, or m, k or c does not have n values.
    """

    m: Annotated[
        PerMass,
        key(
            "mass_kg",
            table="structure",
            above=0.0,
            help="Mass, one for all or one each from the screw outwards (Eq 9); with a rigid screw the first of each "
            "list is inert (Eq 10).",
        ),
    ]
    k: Annotated[
        PerMass,
        key("stiffness_n_per_m", table="structure", above=0.0, help="Stiffness of the springs, one for all or a list."),
    ]
    c: Annotated[
        PerMass,
        key("damping_n_s_per_m", table="structure", minimum=0.0, help="Damping of the springs, one for all or a list."),
    ]
    J: Annotated[float, key("inertia_kg_m2", table="motor", above=0.0, help="Inertia of the rotor (Eqs 1-8).")]
    p: Annotated[float, key("pitch_m_per_rad", table="screw", above=0.0, help="Pitch of the lead screw.")]
    L: Annotated[float, key("inductance_h", table="motor", above=0.0, help="Inductance of the winding.")]
    R: Annotated[float, key("resistance_ohm", table="motor", above=0.0, help="Resistance of the winding.")]
    k_T: Annotated[float, key("torque_gain_n_m_per_a", table="motor", above=0.0, help="Torque per current.")]
    k_B: Annotated[float, key("back_emf_v_s_per_rad", table="motor", above=0.0, help="Back-EMF per angular velocity.")]
    controller: Annotated[
        Controller, key(help="The controller that runs when none is given; it also carries voltage and rate limits.")
    ]
    n: Annotated[
        int, key("masses", table="structure", minimum=2, maximum=100, required=True, help="Number of masses.")
    ] = 3
    k_d: Annotated[
        float,
        key(
            "stiffness_n_per_m",
            table="screw",
            above=0.0,
            infinite=True,
            help="Stiffness between screw and first mass; inf (the paper's) means a rigid screw and no reaction on the "
            "motor, a finite one an elastic screw whose load acts back on the motor.",
        ),
    ] = math.inf
    encoder_resolution: Annotated[
        float,
        key("encoder_resolution_rad", table="sensors", minimum=0.0, help="One count of the motor's encoder; 0: ideal."),
    ] = 0.0
    position_resolution: Annotated[
        float,
        key("position_resolution_m", table="sensors", minimum=0.0, help="One count of the position sensor; 0: ideal."),
    ] = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.controller, Controller):
            raise InvalidInput(f"servo controller = {self.controller!r}: must be a Controller")
        for name in ("m", "k", "c"):
            if isinstance(getattr(self, name), Iterable) and not isinstance(getattr(self, name), str):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        check(self)
        for name in _PLANT:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != self.n:
                count = f"has {len(value)} values for {self.n} masses; give one or {self.n}"
                own = next(item.exact_name for item in items_of(type(self)) if item.name == name)
                raise InvalidInput(f"servo {name} ({own}) = {value!r}: {count}")
            if name != "n":
                object.__setattr__(self, name, tuple(map(float, value)) if isinstance(value, tuple) else float(value))
        object.__setattr__(self, "controller", released(self.controller, self.margins))

    def __repr__(self) -> str:
        """Preset or model version, masses, screw and controller in one line."""
        name = next((repr(name) for name in PRESETS if _preset_version(name) == self.version), "other")
        screw = "rigid" if self.rigid else f"k_d={self.k_d:g} N/m"
        return f"<Servo {name}, model {self.version}: {self.n} masses, {screw} screw, {self.controller!r}>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        rows = {one.name: f"{getattr(self, one.name)} {one.unit}" for one in items_of(type(self))}
        return html_table(f"Servo, model {self.version}", rows)

    @classmethod
    def preset(cls, name: str = "paper") -> Servo:
        """One of the paper's servos: "paper", "table1" or "paper-gain2" (erratum E1 says how they differ)."""
        if name not in PRESETS:
            hint = did_you_mean(name, PRESETS)
            raise InvalidInput(f"preset {name!r} does not exist{hint}; give one of {', '.join(PRESETS)}")
        text = resources.files("servotwin.plant").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
        return cls._from_table(parse_toml(text, f"{name}.toml"))

    @classmethod
    def load(cls, path: str | os.PathLike[str], tuned: bool = True) -> Servo:
        """A servo from a TOML file with unit-carrying keys, as `dumps` writes it.

        Where it is not `tuned` yet, its loop may be unstable.

        Raises
        ------
        InvalidInput
            The file is missing or not TOML, a key is unknown or missing, a value is out of its range.
        """
        return cls._from_table(read_toml(path), tuned)

    @classmethod
    def loads(cls, text: str, source: str) -> Servo:
        """A servo from TOML text; `source` is its name in messages."""
        return cls._from_table(parse_toml(text, source))

    @classmethod
    def resolve(cls, name_or_path: str, folder: str | os.PathLike[str] = ".") -> Servo:
        """A preset's name, or the path of a servo's TOML relative to `folder`."""
        path = Path(folder) / name_or_path
        # A bare word that is no file is a misspelt preset, of which `preset` says more than `load` could.
        is_preset = name_or_path in PRESETS or not (path.suffix or path.exists())
        return cls.preset(name_or_path) if is_preset else cls.load(path)

    @classmethod
    def _from_table(cls, table: Table, tuned: bool = True) -> Servo:
        with named(table):
            servo: Servo = read(table, cls)
            table.done()
            if tuned:
                servo.check_loop()
            return servo

    def dumps(self) -> str:
        """The servo as TOML that `load` reads back to an equal servo."""
        return dumps(values_of(self, only=(*_PLANT, "controller")))

    def replace(self, **changes: Unpack[ServoChanges]) -> Servo:
        """A copy with some values changed, validated again.

        Parameters
        ----------
        **changes
            Any fields of the servo or of its controller, by name: ``servo.replace(k=9e3, Ki=500.0)``.

        Raises
        ------
        InvalidInput
            A name is unknown, or a value is out of its range.
        """
        known = [*(each.name for each in dataclasses.fields(Servo)), *_CONTROLLER_FIELDS]
        refuse_unknown(changes, known, "servo has no value")
        for_plant = {key: value for key, value in changes.items() if key not in _CONTROLLER_FIELDS}
        for_controller = {key: value for key, value in changes.items() if key in _CONTROLLER_FIELDS}
        changed = dataclasses.replace(self, **for_plant)  # type: ignore[arg-type]
        if not for_controller:
            return changed
        return dataclasses.replace(changed, controller=dataclasses.replace(changed.controller, **for_controller))  # type: ignore[arg-type]

    def scaled(self, factors: Mapping[str, float]) -> Servo:
        """A copy with some of the plant's numbers multiplied; nothing else is validated again, for machines are drawn
        by the hundred.

        Parameters
        ----------
        factors : mapping of str to float
            By name of the number; positive.

        Raises
        ------
        InvalidInput
            A factor is not positive and finite.
        """
        own = self.__dict__
        values = {name: own[name] for name in (*_PLANT, "controller")}
        for name, factor in factors.items():
            if not 0.0 < factor < math.inf:
                raise InvalidInput(f"servo {name}: factor {factor!r} must be positive and finite")
            value = values[name]
            values[name] = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
        copy = object.__new__(type(self))
        copy.__dict__.update(values)
        return copy

    @property
    def pidf(self) -> Controller:
        """The controller."""
        return self.controller

    @property
    def command_per_speed(self) -> float:
        """Voltage of a constant speed of the motor, V s/rad: the back EMF."""
        return self.k_B

    def command_of(self, torque: float | Array) -> Any:
        """Voltage of a constant torque, V."""
        return torque * self.R / self.k_T

    def torque_of(self, command: float) -> float:
        """Torque at rest under a voltage, N m."""
        return command * self.k_T / self.R

    @property
    def takes_friction(self) -> bool:
        """True where Coulomb friction on the motor can be simulated."""
        return True

    @property
    def sensors(self) -> Sensors:
        """Encoders, whose readings are off by nothing but their counts."""
        return _sensors(self.encoder_resolution, self.position_resolution)

    def with_position_resolution(self, resolution: float) -> Servo:
        """A copy whose position sensor has another resolution, m."""
        return self.replace(position_resolution=resolution)

    def tolerance_for(self, gap: float, k_dz: float = 1.0) -> float:
        """Dead-zone half-width (m) for a total gap (rad): k_dz p gap (Eq 21).

        Raises
        ------
        InvalidInput
            The gap or k_dz is negative or not finite, or the gap is above one turn.
        """
        return tolerance_of(self.p, gap, k_dz)

    @property
    def largest_gap(self) -> float:
        """Largest total gap, rad: one turn of the motor."""
        return LARGEST_GAP

    @property
    def masses(self) -> Array:
        """(n,) kg."""
        return _spread(self.m, self.n)

    @property
    def stiffnesses(self) -> Array:
        """(n,) N/m."""
        return _spread(self.k, self.n)

    @property
    def dampings(self) -> Array:
        """(n,) N s/m."""
        return _spread(self.c, self.n)

    @property
    def rigid(self) -> bool:
        """True when the first mass follows the screw (k_d infinite)."""
        return math.isinf(self.k_d)

    at_motor, guide, motor_friction, own_friction = False, Guide(), 0.0, 0.0
    motor_stribeck, command_limit = Stribeck(), None

    @property
    def backlash_kind(self) -> BacklashKind:
        """Kind of the backlash: the screw is held in the gap."""
        return BacklashKind.RIGID if self.rigid else BacklashKind.HELD

    @cached_property
    def version(self) -> str:
        """Twelve hexadecimal digits that name this plant's numbers (the controller's do not count)."""
        return hashlib.sha256(dumps(values_of(self, only=_PLANT)).encode()).hexdigest()[:12]

    def chain(self) -> Chain:
        """Matrices of the structure (Eqs 9-13)."""
        return self._matrices[0]

    def motor(self) -> tuple[Array, Array, Array]:
        """Matrices A (3, 3), B (3,) of the voltage, E (3,) of a torque, for (current, speed, angle) (Eqs 1-8)."""
        return self._matrices[1]

    def at_rest(self, screw: float) -> tuple[float, Array]:
        """Angle of the screw (rad) and state of the structure at rest, for a start of the screw at an angle."""
        return screw, self.chain().equilibrium(self.p * screw)

    def rest_under_force(self, gap: float, screw: float) -> None:  # noqa: ARG002
        """Nothing hangs: no force acts on its load."""
        return

    def shaft(self) -> ShaftMatrices:
        """Matrices of the motor by name of its states."""
        return self._matrices[2]

    @property
    def _motor(self) -> Motor:
        return Motor(self.J, self.L, self.R, self.k_T, self.k_B)

    @property
    def _structure(self) -> Structure:
        return Structure(self.masses, self.stiffnesses, self.dampings, self.k_d)

    @cached_property
    def _matrices(self) -> tuple[Chain, tuple[Array, Array, Array], ShaftMatrices]:
        """Structure and motor, computed once: an automaton asks for them dozens of times."""
        links = chain(self.masses, self.stiffnesses, self.dampings, self.k_d)
        return links, self._motor.matrices(), self._motor.shaft()

    def G1(self) -> LinearSystem:
        """Voltage to the unloaded motor's angle (Eq 8)."""
        return loop.motor_system(self._motor)

    def G2(self) -> LinearSystem:
        """Angle of the screw to the position of the last mass (Eq 13)."""
        return loop.structure_system(self._structure, self.p)

    def plant(self) -> LinearSystem:
        """Voltage to the position of the last mass without a gap; G1 G2 with a rigid screw."""
        return loop.plant_system(self._motor, self._structure, self.p)

    def loop(self, controller: Controller | None = None) -> LinearSystem:
        """L = C_PIDF G1 G2 and, where the controller has one, the loop filter; in continuous time, without a gap."""
        return loop.open_loop(self.plant(), controller or self.controller)

    def closed_loop(self, controller: Controller | None = None) -> LinearSystem:
        """Reference to the position of the last mass (Eq 15), in continuous time, without a gap."""
        return loop.closed_loop(self.plant(), controller or self.controller)

    def margins(self, controller: Controller | None = None) -> Margins:
        """All crossovers and margins, Ms, bandwidth and stability of the loop without a gap."""
        return margins(self.loop(controller), self.closed_loop(controller))

    def check_loop(self, controller: AnyController | None = None) -> None:
        """Refuse a controller that does not stabilise the servo even without a gap, at its sample rate if it has one.

        Raises
        ------
        InvalidInput
            With the fastest growing pole.
        """
        law = filtered_pid(controller or self.controller)
        with loop.computable(lambda: values_of(self, only=_PLANT) | {"controller": values_of(law)}):
            loop.check_stable(self.plant(), law, "servo")

    def to_control(self) -> Control:
        """G1, G2, C, the loop and the closed loop as python-control systems (needs the extra `interop`)."""
        return Control.of(self.G1(), self.G2(), loop.pidf(self.controller), self.loop(), self.closed_loop())


@lru_cache(maxsize=64)
def _sensors(encoder_resolution: float, position_resolution: float) -> Sensors:
    """Encoders with counts, made once: machines are drawn by the hundred."""
    return Sensors(encoder_resolution, position_resolution)


@cache
def _preset_version(name: str) -> str:
    return Servo.preset(name).version


def _spread(value: PerMass, n: int) -> Array:
    return np.broadcast_to(np.asarray(value, dtype=float), (n,)).copy()
