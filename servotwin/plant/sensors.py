"""Sensors of an axis: encoders at the motor and at the load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.control.linear_law import LOAD, MOTOR

__all__ = ["LOAD", "MOTOR", "Sensors"]


@settings("sensors")
@dataclass(frozen=True)
class Sensors:
    """Resolutions of the encoders, and the one on which the controller acts.

    Raises
    ------
    InvalidInput
        A value out of its range.
    """

    encoder_resolution: Annotated[
        float,
        key("encoder_resolution_rad", minimum=0.0, help="One count of the motor's encoder; 0: ideal."),
    ] = 0.0
    position_resolution: Annotated[
        float,
        key(
            "position_resolution_m",
            minimum=0.0,
            help="One count of the load's encoder; 0: ideal.",
        ),
    ] = 0.0
    feedback: Annotated[
        str,
        key(
            choices=(LOAD, MOTOR),
            help="Encoder on which the position is controlled; the motor's counts times the transmission's ratio.",
        ),
    ] = LOAD

    def __post_init__(self) -> None:
        check(self)
        for name in ("encoder_resolution", "position_resolution"):
            object.__setattr__(self, name, float(getattr(self, name)))
