"""A recording of two encoders: the input of the kinematic estimate, in whatever units its log has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from servotwin.plant.signals import Array


@dataclass(frozen=True, eq=False)
class EncoderRecording:
    """Samples of one machine, in increasing time, not necessarily uniform.

    Attributes
    ----------
    time : (n,) array
        s.
    motor, load : (n,) array
        Positions before and behind the gap, each in its own unit.
    command : (n,) array or None
        What drives the motor, in its own unit: shows how far the transmission winds up.
    motor_unit, load_unit : str
    source : str
        Where it is from, for messages.
    motor_count, load_count : float or None
        One count of each encoder; None: what the samples show.
    alone : (n,) bool array or None
        Of a thinned log: turning points between stretches at the full rate; they move the play and count for no fit.
    """

    time: Array
    motor: Array
    load: Array
    command: Array | None = None
    motor_unit: str = "rad"
    load_unit: str = "rad"
    source: str = "recording"
    motor_count: float | None = None
    load_count: float | None = None
    alone: np.ndarray[Any, np.dtype[np.bool_]] | None = None
