"""Machines that can be simulated, by name or file: the paper's servo, and axes made of parts."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from servotwin.config.keys import Form, key
from servotwin.config.table import Table, did_you_mean, parse_toml, read_toml
from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.servo import PRESETS, Servo

Plant: TypeAlias = Servo | Axis
"""A machine that can be simulated: the paper's servo, or an axis made of parts."""


_Plant = TypeVar("_Plant", bound=Plant)


def resolve_plant(name_or_path: str, folder: str | os.PathLike[str] = ".", tuned: bool = True) -> Plant:
    """A preset's name, or the path of the TOML of a servo or of an axis, relative to `folder`.

    Where it is not `tuned` yet, its loop may be unstable, and an axis's controller or its gains may be missing.

    Raises
    ------
    InvalidInput
        There is no such preset or file, or the file is not valid.
    """
    if name_or_path in PRESETS:
        return Servo.preset(name_or_path)
    path = Path(folder) / name_or_path
    if name_or_path in AXES:
        return Axis.preset(name_or_path)
    # A bare word that is no file is a misspelt preset.
    if not (path.suffix or path.exists()):
        every = (*PRESETS, *AXES)
        hint = did_you_mean(name_or_path, every)
        raise InvalidInput(f"preset {name_or_path!r} does not exist{hint}; give one of {', '.join(every)}")
    values = read_toml(path).values
    if {"servo", "duration_s"} <= values.keys():
        raise InvalidInput(
            f"{path}: is a scenario, not a servo or an axis; its key 'servo' names its servo, "
            f"{values['servo']!r}: give that"
        )
    return Axis.from_file(path, tuned) if "actuator" in values else Servo.load(path, tuned)


def plant_of(text: str, source: str) -> Plant:
    """A servo or an axis from the text of its file; `source` is its name in messages."""
    return Axis.loads(text, source) if "actuator" in parse_toml(text, source).values else Servo.loads(text, source)


def structure_of(plant: Plant) -> tuple[object, ...]:
    """Make the key that plants share whose automata have the same states and modes."""
    if isinstance(plant, Servo):
        # Machines are drawn by the hundred: their matrices are not made for this.
        return type(plant), plant.n, plant.backlash_kind
    guide, damped = plant.guide, bool(np.any(plant.chain().reaction_velocity))
    forces = bool(guide.friction), bool(guide.force), bool(plant.motor_friction), plant.command_limit is not None
    falling = bool(plant.motor_stribeck.slope), bool(guide.stribeck.slope)
    hangs = math.copysign(1.0, guide.force) if abs(guide.force) > guide.friction + guide.stribeck.drop else 0.0
    return (
        type(plant),
        hangs,
        plant.n,
        plant.backlash_kind,
        damped,
        plant.shaft().names,
        plant.at_motor,
        *forces,
        *falling,
    )


def check_homogeneous(plant: Plant, described: str) -> None:
    """Refuse a plant whose motions do not scale with its gap and reference.

    Raises
    ------
    InvalidInput
        It has Coulomb friction, a constant force or a drive with a limit.
    """
    if plant.motor_friction or plant.guide.friction or plant.guide.force or plant.command_limit is not None:
        raise InvalidInput(
            f"{described}: is computed for one gap and scaled to others, but friction, constant forces and the drive's "
            "limit of this axis do not scale with its gap"
        )


def check_gap_in_loop(plant: Plant) -> None:
    """Refuse an axis whose loop does not depend on the gap, or not in a known way, for the verification of settings.

    Raises
    ------
    InvalidInput
        Its controller reads the motor's encoder, and the gap holds the driven end.
    """
    if plant.at_motor and plant.backlash_kind is not BacklashKind.FREE:
        why = "and settings of such a loop are verified for shafts that are free in the gap only"
        if plant.rigid:
            why = (
                "on which no load acts back in this model, so that its loop does not depend on the gap and there is "
                "nothing to verify"
            )
        raise InvalidInput(
            f'sensors.feedback = "motor": the controller reads the motor, {why}; the feedback must be "load", or the '
            "transmission free in the gap"
        )


def _named_plant(table: Table, name: str, plant: str, folder: Path) -> Plant:
    """Load the servo or axis that a file names."""
    if plant not in (*PRESETS, *AXES) and not (folder / plant).is_file():
        every = (*PRESETS, *AXES)
        hint = did_you_mean(plant, every)
        allowed = f"one of {', '.join(every)}, or the path of a servo's or an axis's TOML, relative to this file{hint}"
        raise table.invalid(name, allowed)
    return resolve_plant(plant, folder)


PLANT_KEY = key(
    form=Form.TEXT,
    parse=_named_plant,
    help="A preset, or the path of the TOML of a servo or of an axis, relative to this file.",
)
"""Key of a machine in the files that name one."""


def prompt_plant(plant: _Plant) -> _Plant:
    """The plant with encoders that are not late, and one of the motor: what windows are of once they are prompt."""
    if not isinstance(plant, Axis):
        return plant
    sensors = replace(plant.sensors, encoder_delay=0.0, position_delay=0.0, motor_encoder=True)
    return plant if sensors == plant.sensors else replace(plant, sensors=sensors)
