"""File of an axis: TOML with the unit in every key."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

from servotwin.config.keys import Maker, items_of, key
from servotwin.config.own_units import OwnUnits
from servotwin.config.table import Table
from servotwin.config.toml import Values, kind_of, read, read_kind, values_of
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import CASCADE, CONTROLLERS, FILTERED_PID, LINEAR_LAW, AnyController
from servotwin.control.laws import kind_of as kind_of_law
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import ACTUATORS, Actuator
from servotwin.plant.linear_law_file import linear_law
from servotwin.plant.load import LINEAR, ROTARY, Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.transmission import FREE, HELD, Transmission

_IN_GAP = key(
    choices=(HELD, FREE),
    help="The driven end inside the gap: held where it is by its own friction, or free to follow the load.",
)


def screw(
    p: Annotated[float, key("pitch_m_per_rad", "lead_mm_per_rev", above=0.0, help="Travel per angle of the motor.")],
    k_d: Annotated[
        float, key("stiffness_n_per_m", above=0.0, infinite=True, help="Stiffness between the gap and the first mass.")
    ] = math.inf,
    c_d: Annotated[float, key("damping_n_s_per_m", minimum=0.0, help="Damping beside it.")] = 0.0,
    in_gap: Annotated[str, _IN_GAP] = HELD,
) -> Transmission:
    """Screw, rack or belt."""
    _check_shaft(k_d, c_d, in_gap, ("stiffness_n_per_m", "damping_n_s_per_m", "N s/m"))
    return Transmission(p, k_d, c_d, in_gap)


def gear(
    ratio: Annotated[
        float | None,
        key(above=0.0, unit="turns of the motor per turn of the load", help="Gear ratio; 1: direct drive."),
    ] = None,
    p: Annotated[
        float | None,
        key("travel_rad_per_rad", above=0.0, help="Turn of the load per turn of the motor, in place of the ratio."),
    ] = None,
    k_d: Annotated[
        float,
        key("stiffness_n_m_per_rad", above=0.0, infinite=True, help="Stiffness between gap and load, at the load."),
    ] = math.inf,
    c_d: Annotated[float, key("damping_n_m_s_per_rad", minimum=0.0, help="Damping beside it.")] = 0.0,
    in_gap: Annotated[str, _IN_GAP] = HELD,
) -> Transmission:
    """Gear or direct drive."""
    if (ratio is None) == (p is None):
        raise InvalidInput("transmission: give either ratio or travel_rad_per_rad")
    _check_shaft(k_d, c_d, in_gap, ("stiffness_n_m_per_rad", "damping_n_m_s_per_rad", "N m s/rad"))
    return Transmission(p if ratio is None else 1.0 / ratio, k_d, c_d, in_gap)  # type: ignore[arg-type]


def _check_shaft(k_d: float, c_d: float, in_gap: str, keys: tuple[str, str, str]) -> None:
    """Refuse a shaft that does not fit its gap; `keys` of stiffness and damping, and the damping's unit."""
    stiffness, damping, unit = keys
    if in_gap == FREE and math.isinf(k_d):
        raise InvalidInput(f'in_gap = "free": needs a finite {stiffness}; a rigid transmission is "held" in the gap')
    if c_d > 0.0 and math.isinf(k_d):
        raise InvalidInput(
            f"{damping} = {c_d!r} {unit}: needs a finite {stiffness}, beside which it damps; leave it out, or give that"
        )


def linear_load(
    m: Annotated[tuple[float, ...], key("mass_kg", above=0.0, help="Masses, from the transmission outwards.")],
    k: Annotated[
        tuple[float, ...],
        key(
            "stiffness_n_per_m",
            minimum=0.0,
            help="Stiffness between each and the one before; the first is to the ground, 0: a free load.",
        ),
    ] = (0.0,),
    c: Annotated[
        tuple[float, ...],
        key(
            "damping_n_s_per_m", minimum=0.0, help="Damping likewise; the first is the viscous friction of a free load."
        ),
    ] = (0.0,),
    friction: Annotated[float, key("friction_n", minimum=0.0, help="Coulomb friction on the last mass.")] = 0.0,
    force: Annotated[float, key("force_n", help="Constant force on the last mass, gravity for one.")] = 0.0,
    static: Annotated[
        float | None,
        key("static_friction_n", above=0.0, help="Its friction at standstill; absent: the Coulomb friction."),
    ] = None,
    stribeck: Annotated[
        float | None,
        key(
            "stribeck_speed_m_per_s", above=0.0, help="Speed at which the friction has fallen to the Coulomb friction."
        ),
    ] = None,
) -> Load:
    """Masses on a line."""
    return Load(m, k, c, LINEAR, friction, force, static, stribeck)


def rotary_load(
    m: Annotated[tuple[float, ...], key("inertia_kg_m2", above=0.0, help="Inertias, from the transmission outwards.")],
    k: Annotated[
        tuple[float, ...],
        key(
            "stiffness_n_m_per_rad",
            minimum=0.0,
            help="Stiffness between each and the one before; the first is to the ground, 0: a free load.",
        ),
    ] = (0.0,),
    c: Annotated[
        tuple[float, ...],
        key(
            "damping_n_m_s_per_rad",
            minimum=0.0,
            help="Damping likewise; the first is the viscous friction of a free load.",
        ),
    ] = (0.0,),
    friction: Annotated[float, key("friction_n_m", minimum=0.0, help="Coulomb friction on the last inertia.")] = 0.0,
    force: Annotated[float, key("torque_n_m", help="Constant torque on the last inertia, gravity for one.")] = 0.0,
    static: Annotated[
        float | None,
        key("static_friction_n_m", above=0.0, help="Its friction at standstill; absent: the Coulomb friction."),
    ] = None,
    stribeck: Annotated[
        float | None,
        key(
            "stribeck_speed_rad_per_s",
            above=0.0,
            help="Speed at which the friction has fallen to the Coulomb friction.",
        ),
    ] = None,
) -> Load:
    """Inertias on a shaft."""
    return Load(m, k, c, ROTARY, friction, force, static, stribeck)


TRANSMISSIONS: Mapping[str, Maker] = {"screw": screw, "gear": gear}
LOADS: Mapping[str, Maker] = {"linear": linear_load, "rotary": rotary_load}
LAWS: Mapping[str, Maker] = {**CONTROLLERS, LINEAR_LAW: linear_law}
"""Controllers that the file of an axis can describe, by their key `kind`."""
_MASSES = {LINEAR: "mass_kg", ROTARY: "inertia_kg_m2"}
_MOTIONS = {"screw": LINEAR, "gear": ROTARY}


class Parts(NamedTuple):
    """Parts of an axis, as its file describes them."""

    actuator: Actuator
    transmission: Transmission
    load: Load
    controller: AnyController
    sensors: Sensors


def read_parts(table: Table, folder: Path, tuned: bool = True) -> Parts:
    """Read the parts of an axis from its file's table, to the last key; paths are relative to `folder`.

    Where the axis is not `tuned` yet, the controller or its gains may be missing.

    Raises
    ------
    InvalidInput
        A key is missing or unknown, a value is out of its range, the load is not of the transmission's kind.
    """
    tables = {name: table.table(name, required=True) for name in ("actuator", "transmission", "load")}
    described = table.table("controller", required=tuned)
    actuator: Actuator = read_kind(tables["actuator"], ACTUATORS, Path())
    kind = kind_of(tables["transmission"], TRANSMISSIONS)
    both = [name for name in ("pitch_m_per_rad", "lead_mm_per_rev") if name in tables["transmission"].values]
    if len(both) == 2:
        raise InvalidInput(f"{table.source}: transmission.{both[0]} and transmission.{both[1]}: give only one of them")
    transmission: Transmission = read_kind(tables["transmission"], TRANSMISSIONS, Path())
    motion = kind_of(tables["load"], LOADS)
    if motion != _MOTIONS[kind]:
        raise tables["load"].invalid("kind", f'"{_MOTIONS[kind]}", for the transmission is a {kind}')
    for name, own in ((_MASSES[each], _MASSES[motion]) for each in _MASSES if each != motion):
        if name in tables["load"].values:
            raise InvalidInput(
                f"{table.source}: load.{name} = {tables['load'].values[name]!r}: this load is {motion}; give load.{own}"
            )
    load: Load = read_kind(tables["load"], LOADS, Path())
    law = _read_controller(described, folder, actuator.unit, motion, transmission.p, tuned)
    encoders = table.table("sensors").in_units(units_of(actuator.unit, motion))
    if motion == LINEAR and "position_counts_per_rev" in encoders.values:
        raise encoders.invalid("position_counts_per_rev", "position_resolution_m, for a linear load makes no turns")
    sensors: Sensors = read(encoders, Sensors)
    encoders.done()
    table.done()
    return Parts(actuator, transmission, load, law, sensors)


def _read_controller(table: Table, folder: Path, unit: str, motion: str, ratio: float, tuned: bool) -> AnyController:
    """Read the controller in the units of its axis; the ratio is the transmission's where it is not given."""
    kind = kind_of(table, LAWS, FILTERED_PID)
    units = units_of(unit, motion)
    controller = table.in_units(units)
    controller.known("kind")
    own = {"ratio": ratio} if kind != FILTERED_PID and units.key("travel_m_per_rad") not in controller.values else {}
    law: AnyController = read(controller, LAWS[kind], folder, None if tuned else _untuned(kind, unit), **own)
    controller.done()
    return law


def _untuned(kind: str, unit: str) -> AnyController | None:
    """A controller whose gains stand for those that a file to be tuned may lack; None: of this kind none is tuned."""
    if kind == CASCADE:
        return Cascade(0.0, 1.0, velocity_gain=None if unit == "rad/s" else 1.0)
    return Controller(0.0, 0.0, 0.0, 1.0) if kind == FILTERED_PID else None


def units_of(command: str, motion: str) -> OwnUnits:
    """Units of an axis, from that of its actuator's command and the motion of its load."""
    return OwnUnits(command, "m" if motion == LINEAR else "rad")


def file_values(controller: AnyController, unit: str, motion: str, only: Collection[str] | None = None) -> Values:
    """Keys and values of a controller, as the file of an axis has them; `only` of some attributes."""
    maker: Maker = linear_law if isinstance(controller, LinearLaw) else type(controller)
    if only is None and isinstance(controller, LinearLaw):
        only = [item.name for item in items_of(linear_law) if item.name != "system"]
    return units_of(unit, motion).named(values_of(controller, maker, only))


def described_law(controller: AnyController, unit: str, motion: str) -> str:
    """Kind, keys and values of a controller that are not their defaults, as the file of an axis has them."""
    if isinstance(controller, LinearLaw):
        return repr(controller)
    names = [item.name for item in items_of(type(controller)) if getattr(controller, item.name) != item.default]
    values = file_values(controller, unit, motion, names)
    return f"{kind_of_law(controller)} ({', '.join(f'{key} = {value!r}' for key, value in values.items())})"


def values_of_parts(axis: Parts) -> Values:
    """The tables of an axis's file, which `read_parts` reads back to equal parts."""
    motion = axis.load.motion
    kind = next(kind for kind, moves in _MOTIONS.items() if moves == motion)
    actuator = next(name for name, maker in ACTUATORS.items() if isinstance(axis.actuator, maker))
    named: Values = {} if isinstance(axis.controller, Controller) else {"kind": kind_of_law(axis.controller)}
    controller = named | file_values(axis.controller, axis.actuator.unit, motion)
    return {
        "actuator": {"kind": actuator, **values_of(axis.actuator)},
        "transmission": {"kind": kind, **_transmission_values(axis.transmission, kind)},
        "load": {"kind": motion, **values_of(axis.load, LOADS[motion])},
        "sensors": units_of(axis.actuator.unit, motion).named(values_of(axis.sensors)),
        "controller": controller,
    }


def _transmission_values(transmission: Transmission, kind: str) -> Values:
    if kind == "screw":
        return values_of(transmission, screw)
    near = 1.0 / transmission.p
    # A ratio of 105 is not written as 104.99999999999999.
    close = (float(f"{near:.15g}"), near, math.nextafter(near, math.inf), math.nextafter(near, 0.0))
    ratio = next((each for each in close if 1.0 / each == transmission.p), None)
    turns = {"travel_rad_per_rad": transmission.p} if ratio is None else {"ratio": ratio}
    return {**turns, **values_of(transmission, gear, only=("k_d", "c_d", "in_gap"))}
