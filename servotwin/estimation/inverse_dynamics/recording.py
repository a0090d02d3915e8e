"""A recording of a drive's command and position: the input of the inverse-dynamic fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from servotwin.plant.signals import Array

Mask = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True, eq=False)
class DriveRecording:
    """Uniform samples of one drive.

    Attributes
    ----------
    rate : float
        Hz.
    position : (n,) array
        Of the encoder beside the motor, m, of a rotary axis rad.
    force : (n,) array
        Command times `force_per_command`: N, of a rotary axis N m; the command itself where no scale is known.
    reference : (n,) array or None
        Of the position, in its unit.
    load : (n,) array or None
        Position of a second encoder behind shaft and gap, m (rotary: rad).
    usable : (n,) bool array
        False where samples were missing.
    rotary : bool
    force_per_command : float or None
        N (rotary: N m) per unit of the command; None: unknown, and the fit is in units of the command.
    resolution, load_resolution : float
        One count of the position, and of the second encoder.
    limit : float or None
        Largest force, where the command stays at it; None: it stays at none.
    command_unit, source : str
    """

    rate: float
    position: Array
    force: Array
    usable: Mask
    reference: Array | None = None
    load: Array | None = None
    rotary: bool = False
    force_per_command: float | None = None
    resolution: float = 0.0
    load_resolution: float = 0.0
    limit: float | None = None
    command_unit: str = ""
    source: str = "recording"

    @property
    def duration(self) -> float:
        """Length, s."""
        return self.position.size / self.rate

    @property
    def unit(self) -> str:
        """Unit of the position."""
        return "rad" if self.rotary else "m"

    @property
    def force_unit(self) -> str:
        """Unit of the force."""
        if self.force_per_command is None:
            return self.command_unit or "command"
        return "N m" if self.rotary else "N"

    @property
    def inertia_unit(self) -> str:
        """Unit of the inertia that force and position make."""
        if self.force_per_command is None:
            return f"{self.force_unit} s^2/{self.unit}"
        return "kg m^2" if self.rotary else "kg"


def held_command(recording: DriveRecording) -> DriveRecording:
    """The recording with the force that moves the drive about each sample if the command is held from one to the next.

    It is the mean of the command that ends there and of the one that begins: of a held force the second difference of
    the position is exactly that.
    """
    before = np.concatenate([recording.force[:1], recording.force[:-1]])
    return replace(recording, force=0.5 * (recording.force + before))
