"""A servo axis made of parts: actuator, transmission, load, sensors and the controller that runs by default."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from servotwin.config.table import Table, did_you_mean, named, parse_toml, read_toml
from servotwin.config.toml import dumps
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, filtered_pid, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant import loop
from servotwin.plant.actuator import Actuator, ShaftMatrices, static_torque
from servotwin.plant.axis_file import Parts, described_law, read_parts, values_of_parts
from servotwin.plant.basis import BacklashKind, Guide, Stribeck
from servotwin.plant.changes import AxisChanges, refuse_unknown
from servotwin.plant.fit import PARTS, check_damped, check_fit, check_kinds
from servotwin.plant.law_loop import LawLoop
from servotwin.plant.linear import LinearSystem
from servotwin.plant.load import LINEAR, ROTARY, Load
from servotwin.plant.loop_set import sampled_margins
from servotwin.plant.margins import Margins, margins
from servotwin.plant.numbers import tolerance_of
from servotwin.plant.release import released
from servotwin.plant.rest import Rest, rest_under_force
from servotwin.plant.scaled_parts import scaled_parts
from servotwin.plant.sensors import MOTOR, Sensors, check_encoders
from servotwin.plant.signals import LARGEST_GAP, Array
from servotwin.plant.structure import Chain, Structure, chain
from servotwin.plant.transmission import Transmission

AXES = (
    "two-mass-drive", "ball-screw", "robot-joint", "telescope", "stepper-stage", "micro-positioner", "gantry", "emps",
)  # fmt: skip
"""Names of the presets of axes."""


# Stands for the controller where only the plant counts.
_NONE = Controller(0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, repr=False)
class Axis:
    """One axis. The paper's servo is the combination of a DC motor, a rigid screw and a load on the ground.

    Parameters
    ----------
    actuator : DcMotor, TorqueDrive, VelocityDrive or Stepper
    transmission : Transmission
    load : Load
    controller : Controller, Cascade or LinearLaw
        Runs when none is given. The gains of a Controller give the actuator's command (V, N m, rad/s or rad) per
        m, or per rad of a rotary load.
    sensors : Sensors, optional
        Ideal by default.

    Raises
    ------
    InvalidInput
        A part of another type, or parts that do not fit.
    """

    actuator: Actuator
    transmission: Transmission
    load: Load
    controller: AnyController
    sensors: Sensors = field(default_factory=Sensors)

    def __post_init__(self) -> None:
        check_kinds({name: getattr(self, name) for name in PARTS})
        check_fit(self.actuator, self.transmission, self.load, self.controller)
        check_encoders(self, law_of(self.controller))
        object.__setattr__(self, "controller", released(self.controller, self.margins))

    @classmethod
    def preset(cls, name: str) -> Axis:
        """An axis that is packaged; its file names the source of every number.

        Raises
        ------
        InvalidInput
            There is none of that name.
        """
        if name not in AXES:
            hint = did_you_mean(name, AXES)
            raise InvalidInput(f"preset {name!r} does not exist{hint}; give one of {', '.join(AXES)}")
        text = resources.files("servotwin.plant").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
        return cls.loads(text, f"{name}.toml")

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], tuned: bool = True) -> Axis:
        """An axis from a TOML file, as `dumps` writes it.

        Where it is not `tuned` yet, its controller or that one's gains may be missing, and its loop may be unstable.

        Raises
        ------
        InvalidInput
            The file cannot be read, a key is missing or unknown, a value is out of its range, parts do not fit, or the
            loop is unstable.
        """
        return cls._from_table(read_toml(path), Path(path).parent, tuned)

    @classmethod
    def loads(cls, text: str, source: str) -> Axis:
        """An axis from TOML text; `source` is its name in messages."""
        return cls._from_table(parse_toml(text, source))

    @classmethod
    def _from_table(cls, table: Table, folder: Path = Path(), tuned: bool = True) -> Axis:
        with named(table):
            axis = cls(**read_parts(table, folder, tuned)._asdict())
            if tuned:
                axis.check_loop()
            return axis

    def dumps(self) -> str:
        """The axis as TOML that `from_file` reads back to an equal axis."""
        parts = Parts(self.actuator, self.transmission, self.load, self.controller, self.sensors)
        return dumps(values_of_parts(parts))

    @property
    def n(self) -> int:
        """Number of masses."""
        return self.load.n

    @property
    def p(self) -> float:
        """Travel of the load per angle of the motor, m/rad (rotary: rad/rad)."""
        return self.transmission.p

    @property
    def backlash_kind(self) -> BacklashKind:
        """Kind of the backlash."""
        return self.transmission.backlash_kind

    @property
    def rigid(self) -> bool:
        """True where the first mass follows the transmission."""
        return self.transmission.rigid

    @property
    def motor_friction(self) -> float:
        """Coulomb friction of the motor's shaft, N m."""
        return self.actuator.coulomb

    @cached_property
    def motor_stribeck(self) -> Stribeck:
        """Friction of the motor's shaft above Coulomb's near standstill."""
        return Stribeck.of(self.actuator.static, self.actuator.coulomb, self.actuator.stribeck)

    @property
    def command_limit(self) -> float | None:
        """Largest command that the drive follows, either sign; None: any."""
        return self.actuator.limit

    @property
    def own_friction(self) -> float:
        """Friction of motor and load at standstill as a torque on the motor, N m."""
        load = self.load.friction + self.guide.stribeck.drop
        return self.motor_friction + self.motor_stribeck.drop + self.p * load

    @cached_property
    def guide(self) -> Guide:
        """Forces on the last mass."""
        load = self.load
        behind = load.k[-1] if self.n > 1 else self.transmission.k_d
        mass = load.m[-1]
        resisting = load.c[-1] + math.sqrt(mass * behind) if math.isfinite(behind) else 1.0
        falling = Stribeck.of(load.static, load.friction, load.stribeck)
        return Guide(load.friction, load.force, mass, 1.0 / resisting, falling)

    @property
    def at_motor(self) -> bool:
        """True where the controller acts on the motor's encoder instead of the load's."""
        return self.sensors.feedback == MOTOR

    @property
    def position_resolution(self) -> float:
        """One count of the sensor that the controller reads, m (rotary: rad)."""
        return self.p * self.sensors.encoder_resolution if self.at_motor else self.sensors.position_resolution

    @property
    def encoder_resolution(self) -> float:
        """One count of the motor's encoder, rad."""
        return self.sensors.encoder_resolution

    @cached_property
    def version(self) -> str:
        """Twelve hexadecimal digits that name the plant's numbers (the controller's do not count)."""
        plant = values_of_parts(Parts(self.actuator, self.transmission, self.load, _NONE, self.sensors))
        del plant["controller"]
        return hashlib.sha256(dumps(plant).encode()).hexdigest()[:12]

    def __repr__(self) -> str:
        """Parts in one line."""
        kind, masses = type(self.actuator).__name__, f"{self.n} mass{'es' if self.n > 1 else ''}"
        return f"<Axis, model {self.version}: {kind}, {self.backlash_kind.value} screw, {masses}, {self.controller!r}>"

    def chain(self) -> Chain:
        """Matrices of the load."""
        return self._matrices[0]

    def at_rest(self, screw: float) -> tuple[float, Array]:
        """Angle of the driven end (rad) and state of the load at rest, for a start of the driven end at an angle.

        What is free in the gap rests where no force acts: a load on the ground at zero, a free one anywhere.
        """
        if self.backlash_kind is not BacklashKind.FREE:
            return screw, self.chain().equilibrium(self.p * screw)
        screw = screw if self.load.free else 0.0
        return screw, np.concatenate([np.full(self.n, self.p * screw), np.zeros(self.n)])

    def rest_under_force(self, gap: float, screw: float) -> Rest | None:
        """Position at which a load hangs that a constant force pushes; None: nothing does, or friction holds it."""
        return rest_under_force(self, gap, screw)

    def shaft(self) -> ShaftMatrices:
        """Matrices of the actuator."""
        return self._matrices[1]

    @cached_property
    def _matrices(self) -> tuple[Chain, ShaftMatrices]:
        return chain(*self._structure), self.actuator.matrices()

    @property
    def _structure(self) -> Structure:
        load, screw = self.load, self.transmission
        return Structure(load.masses, load.stiffnesses, load.dampings, screw.k_d, screw.c_d)

    def replace(self, **changes: Unpack[AxisChanges]) -> Axis:
        """A copy with some of its parts changed, or some values of its controller.

        Parameters
        ----------
        **changes
            Parts of the axis, and fields of its controller, by name: ``axis.replace(load=load, Kp=500.0)``.

        Raises
        ------
        InvalidInput
            A name is unknown, or a value is out of its range.
        """
        parts = {name: value for name, value in changes.items() if name in PARTS}
        law = {name: value for name, value in changes.items() if name not in PARTS}
        known = [each.name for each in dataclasses.fields(parts.get("controller", self.controller))]  # type: ignore[arg-type]
        refuse_unknown(law, [*PARTS, *known], "axis has no part or gain")
        changed = dataclasses.replace(self, **parts)  # type: ignore[arg-type]
        tuned = dataclasses.replace(changed.controller, **law) if law else changed.controller  # type: ignore[arg-type]
        return dataclasses.replace(changed, controller=tuned) if law else changed

    def scaled(self, factors: Mapping[str, float]) -> Axis:
        """A copy with some of the plant's numbers multiplied.

        Parameters
        ----------
        factors : mapping of str to float
            Positive, by the names of a servo: k (stiffnesses of load and transmission), c (dampings of both), m
            (masses), p (ratio), k_T (torque per command), k_B (back EMF, or viscous friction of a torque drive),
            motor_friction and load_friction (Coulomb and static). A drive that follows its command has none of k_T, k_B
            and motor_friction.

        Raises
        ------
        InvalidInput
            A factor is not positive and finite.
        """
        actuator, screw, load = scaled_parts(self.actuator, self.transmission, self.load, factors)
        return dataclasses.replace(self, actuator=actuator, load=load, transmission=screw)

    @property
    def pidf(self) -> Controller:
        """The controller, where it is a filtered PID.

        Raises
        ------
        InvalidInput
            It is a linear law.
        """
        return filtered_pid(self.controller)

    @property
    def command_per_speed(self) -> float:
        """Command of a constant speed of the motor, per rad/s."""
        shaft = self.actuator.polynomials()
        return float(shaft.shaft[1] / shaft.command[0]) if shaft.shaft[0] == 0.0 else 0.0

    def command_of(self, torque: float | Array) -> Any:
        """Command of a constant torque (N m); 0 for a drive that follows its command whatever the load."""
        return torque * self._at_rest[0] / self._at_rest[1]

    @cached_property
    def _at_rest(self) -> tuple[float, float]:
        """Torque and command of a constant angle, over each other."""
        shaft = self.actuator.polynomials()
        return float(shaft.torque[0]), float(shaft.command[0])

    def torque_of(self, command: float) -> float:
        """Torque at rest under a command, N m; 0 for a drive that follows its command whatever the load."""
        return command * static_torque(self.actuator)

    @property
    def takes_friction(self) -> bool:
        """True where Coulomb friction on the motor can be simulated."""
        return bool(np.any(self.shaft().E))

    def with_position_resolution(self, resolution: float) -> Axis:
        """A copy whose measured position has another resolution, m (rotary: rad)."""
        sensed = {"encoder_resolution": resolution / self.p} if self.at_motor else {"position_resolution": resolution}
        return dataclasses.replace(self, sensors=dataclasses.replace(self.sensors, **sensed))  # type: ignore[arg-type]

    def tolerance_for(self, gap: float, k_dz: float = 1.0) -> float:
        """Half-width of the dead zone (m, rotary: rad) for a total gap (rad at the motor): k_dz p gap (Eq 21).

        Raises
        ------
        InvalidInput
            The gap or k_dz is negative or not finite, or the gap is above `largest_gap`.
        """
        return tolerance_of(self.p, gap, k_dz, self.largest_gap)

    @property
    def largest_gap(self) -> float:
        """Largest total gap, rad at the motor: one turn of the motor, of a gear that reduces one turn of the load."""
        return LARGEST_GAP / min(1.0, self.p) if self.load.motion == ROTARY else LARGEST_GAP

    def G2(self) -> LinearSystem:
        """Angle of the driven end to the position of the last mass."""
        return loop.structure_system(self._structure, self.p)

    def plant(self) -> LinearSystem:
        """Command to the measured position, without a gap."""
        shaft = self.actuator.polynomials()
        return loop.axis_system(self.shaft(), shaft, self._structure, self.p, self.at_motor)

    def plants(self) -> tuple[LinearSystem, LinearSystem]:
        """Command to the motor's angle and to the load's position, without a gap, with the same states."""
        shaft, polynomials = self.shaft(), self.actuator.polynomials()
        load = loop.axis_system(shaft, polynomials, self._structure, self.p, at_motor=False)
        row, unknown = np.eye(load.B.size)[len(shaft.names) - 1], np.array([math.nan])
        return replace(load, C=row, numerator=unknown, denominator=unknown), load

    def _law_loop(self, law: LinearLaw) -> LawLoop:
        check_encoders(self, law)
        late = self.sensors.motor.late(law.sample_rate), self.sensors.load.late(law.sample_rate)
        return LawLoop(*self.plants(), law, late)

    def loop(self, controller: AnyController | None = None) -> LinearSystem:
        """Open loop of controller and plant in continuous time, without a gap; of a linear law cut at the command."""
        law = law_of(controller or self.controller)
        return self._law_loop(law).open() if isinstance(law, LinearLaw) else loop.open_loop(self.plant(), law)

    def closed_loop(self, controller: AnyController | None = None) -> LinearSystem:
        """Reference to the measured position in continuous time, without a gap."""
        law = law_of(controller or self.controller)
        return self._law_loop(law).closed() if isinstance(law, LinearLaw) else loop.closed_loop(self.plant(), law)

    def margins(self, controller: AnyController | None = None) -> Margins:
        """All crossovers and margins, Ms, bandwidth and stability of the loop without a gap.

        In continuous time, unless the law has discrete matrices or a sensor is late.
        """
        law = law_of(controller or self.controller)
        if isinstance(law, LinearLaw):
            return self._law_loop(law).margins()
        if late := self.sensors.fed_back(self.p).late(law.sample_rate):
            return sampled_margins(self.plant(), law, late)
        return margins(self.loop(controller), self.closed_loop(controller))

    def check_loop(self, controller: AnyController | None = None) -> None:
        """Refuse a controller that does not stabilise the axis even without a gap, at its sample rate if it has one.

        Raises
        ------
        InvalidInput
            With the fastest growing pole.
        """
        given = controller or self.controller
        law, unit, motion = law_of(given), self.actuator.unit, self.load.motion
        parts = Parts(self.actuator, self.transmission, self.load, given, self.sensors)
        with loop.computable(lambda: values_of_parts(parts)):
            if isinstance(law, LinearLaw):
                self._law_loop(law).check(described_law(given, unit, motion))
                return
            if self.rigid and self.at_motor:
                check_damped(self.load, self.chain())
            late = self.sensors.fed_back(self.p).late(law.sample_rate)
            loop.check_stable(self.plant(), law, "axis", unit, "m" if motion == LINEAR else "rad", late)
