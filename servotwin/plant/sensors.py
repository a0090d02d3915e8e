"""Sensors of an axis: encoders at the motor and at the load, with what their readings are off by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Protocol

from servotwin.config.keys import check, items_of, key, settings
from servotwin.control.laws import Law
from servotwin.control.linear_law import LOAD, MOTOR, LinearLaw
from servotwin.errors import InvalidInput

__all__ = ["LOAD", "MOTOR", "Encoder", "Sensors", "check_encoders"]

_WHOLE = 1e-6  # of a sample: rounding of a delay that is a whole number of samples


@dataclass(frozen=True)
class Encoder:
    """Readings of one encoder: the motion of `delay` ago, off by `offset` and noise, in whole counts.

    Attributes
    ----------
    resolution, offset, noise : float
        One count (0: ideal), reading at zero, and standard deviation of white noise, in rad or m.
    delay : float
        s.
    """

    resolution: float
    offset: float
    noise: float
    delay: float

    @property
    def true(self) -> bool:
        """True where its readings are those of the instant, but for counts."""
        return self.offset == self.noise == self.delay == 0.0

    def late(self, rate: float | None) -> int:
        """Whole samples at a rate (Hz) by which its readings are late; 0 in continuous time, which has no delay."""
        return 0 if rate is None else round(self.delay * rate)

    def scaled(self, factor: float) -> Encoder:
        """The same readings in another unit."""
        return Encoder(factor * self.resolution, factor * self.offset, factor * self.noise, self.delay)


@settings("sensors")
@dataclass(frozen=True)
class Sensors:
    """Encoders, and the one on which the controller acts.

    Raises
    ------
    InvalidInput
        A value out of its range, or both a resolution and the counts of a turn.
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
    encoder_offset: Annotated[
        float, key("encoder_offset_rad", later=True, help="Reading of the motor's encoder at the angle 0.")
    ] = 0.0
    encoder_noise: Annotated[
        float,
        key(
            "encoder_noise_rad",
            minimum=0.0,
            later=True,
            help="Standard deviation of white noise of the motor's encoder, before its counts.",
        ),
    ] = 0.0
    encoder_delay: Annotated[
        float,
        key(
            "encoder_delay_s",
            minimum=0.0,
            later=True,
            help="Age of the motor's readings: a whole number of samples of the controller.",
        ),
    ] = 0.0
    position_offset: Annotated[
        float, key("position_offset_m", later=True, help="Reading of the load's encoder at the position 0.")
    ] = 0.0
    position_noise: Annotated[
        float,
        key(
            "position_noise_m",
            minimum=0.0,
            later=True,
            help="Standard deviation of white noise of the load's encoder, before its counts; [noise] of a scenario "
            "takes its place.",
        ),
    ] = 0.0
    position_delay: Annotated[
        float,
        key(
            "position_delay_s",
            minimum=0.0,
            later=True,
            help="Age of the load's readings: a whole number of samples of the controller.",
        ),
    ] = 0.0
    encoder_counts: Annotated[
        float | None,
        key(
            "encoder_counts_per_rev",
            above=0.0,
            later=True,
            unit="counts per turn",
            help="Counts of the motor's encoder, in place of its resolution.",
        ),
    ] = None
    position_counts: Annotated[
        float | None,
        key(
            "position_counts_per_rev",
            above=0.0,
            later=True,
            unit="counts per turn",
            help="Counts of a rotary load's encoder, in place of its resolution.",
        ),
    ] = None
    motor_encoder: Annotated[
        bool,
        key(later=True, help="false: the motor has no encoder, and its angle is not measured; the load's encoder is."),
    ] = True

    def __post_init__(self) -> None:
        check(self)
        if not self.motor_encoder:
            self._check_absent()
        for name in ("encoder", "position"):
            counts, resolution = getattr(self, f"{name}_counts"), f"{name}_resolution"
            if counts is not None and getattr(self, resolution) != 0.0:
                raise InvalidInput(f"sensors {name}_counts_per_rev and {resolution}: give only one of them")
            value = getattr(self, resolution) if counts is None else 2.0 * math.pi / counts
            object.__setattr__(self, resolution, float(value))
            # One way to hold it: equal sensors compare equal, whichever key described them.
            object.__setattr__(self, f"{name}_counts", None)

    def _check_absent(self) -> None:
        """Refuse what is stated of the motor's encoder, or asked of it, where there is none."""
        without = "sensors motor_encoder = false: the motor has no encoder, and"
        for item in items_of(type(self)):
            name, stated = item.name, getattr(self, item.name)
            if name.startswith("encoder_") and stated not in (None, item.default):
                unit = f" {item.unit}" if item.unit else ""
                raise InvalidInput(
                    f"{without} {item.names[0]} = {stated!r}{unit} is of one; leave it out, or give "
                    "motor_encoder = true"
                )
        if self.feedback == MOTOR:
            raise InvalidInput(
                f'{without} feedback = "motor" reads it; give feedback = "load", or motor_encoder = true'
            )

    @property
    def motor(self) -> Encoder:
        """Encoder of the motor, rad."""
        return Encoder(self.encoder_resolution, self.encoder_offset, self.encoder_noise, self.encoder_delay)

    @property
    def load(self) -> Encoder:
        """Encoder of the load, m (rotary: rad)."""
        return Encoder(self.position_resolution, self.position_offset, self.position_noise, self.position_delay)

    def fed_back(self, ratio: float) -> Encoder:
        """Encoder of the measured position, in its unit; `ratio`: travel of the load per angle of the motor."""
        return self.motor.scaled(ratio) if self.feedback == MOTOR else self.load

    def check_delays(self, rate: float | None) -> None:
        """Refuse delays that a controller with a sample rate (Hz; None: continuous) does not meet at its samples.

        Raises
        ------
        InvalidInput
            Naming the delay and what is allowed.
        """
        for name in ("encoder_delay", "position_delay"):
            delay = getattr(self, name)
            if delay == 0.0:
                continue
            if rate is None:
                raise InvalidInput(f"sensors {name} = {delay!r} s: needs a controller with a sample rate, or must be 0")
            if abs(delay * rate - round(delay * rate)) > _WHOLE:
                sample = f"samples of {1.0 / rate:g} s"
                raise InvalidInput(f"sensors {name} = {delay!r} s: must be a whole number of the controller's {sample}")


class Sensed(Protocol):
    """A plant with encoders."""

    @property
    def at_motor(self) -> bool:
        """True where the controller acts on the motor's encoder instead of the load's."""
        ...

    @property
    def sensors(self) -> Sensors:
        """Encoders."""
        ...


def check_encoders(plant: Sensed, law: Law) -> None:
    """Refuse a linear law that reads an encoder which the plant's controller does not have, and delays between samples.

    Raises
    ------
    InvalidInput
        The law reads the load, and the controller acts on the motor's encoder; the law reads the motor, which has no
        encoder; an encoder's delay is no whole number of the law's samples; a continuous law reads a motor's encoder
        with an offset or noise.
    """
    if isinstance(law, LinearLaw) and plant.at_motor and law.reads("y_load"):
        raise InvalidInput(
            'sensors feedback = "motor": the controller reads y_load, the load\'s encoder; the feedback must be '
            '"load", or on = "motor" in [controller] of a cascade'
        )
    if isinstance(law, LinearLaw) and not plant.sensors.motor_encoder and law.reads("y_motor"):
        raise InvalidInput(
            "sensors motor_encoder = false: the controller reads y_motor, the motor's encoder, as the velocity loop of "
            "a cascade does; give one that reads the load only, or motor_encoder = true"
        )
    plant.sensors.check_delays(law.sample_rate)
    motor = plant.sensors.motor
    if law.sample_rate is None and isinstance(law, LinearLaw) and law.reads("y_motor") and not motor.true:
        raise InvalidInput(
            f"sensors encoder_offset = {motor.offset!r} rad, encoder_noise = {motor.noise!r} rad: a law that reads the "
            "motor needs a sample rate for these, or they must be 0"
        )
