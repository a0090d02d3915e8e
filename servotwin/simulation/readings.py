"""Readings of the encoders in a simulation: noise that is the same for a sample however it is asked for, and delays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import Noise, NoiseSource
from servotwin.plant.plants import Plant
from servotwin.plant.sensors import Encoder
from servotwin.simulation.inputs import quantised

TICKED_MOTOR = "theta_m at ticks"
"""Channel of the motor's true angle, tick by tick."""
_BLOCK, _REMEMBERED = 4096, 4
# Ticks of a chunk of noise: the first and the largest.
_FIRST_CHUNK, _LARGEST_CHUNK = 1 << 13, 1 << 16


@dataclass
class WhiteNoise:
    """Unit white noise by the number of the step, drawn in blocks of which each has a generator of its own."""

    key: int
    _blocks: dict[int, Array] = field(default_factory=dict)

    def at(self, steps: NDArray[np.int64]) -> Array:
        """(n,) values at steps."""
        out, blocks = np.empty(steps.size), steps // _BLOCK
        for block in np.unique(blocks).tolist():
            here = blocks == block
            out[here] = self._block(block)[steps[here] - block * _BLOCK]
        return out

    def _block(self, block: int) -> Array:
        if block not in self._blocks:
            while len(self._blocks) >= _REMEMBERED:
                self._blocks.pop(next(iter(self._blocks)), None)
            self._blocks[block] = np.random.default_rng([self.key, block]).standard_normal(_BLOCK)
        return self._blocks[block]


@dataclass
class EncoderErrors:
    """Errors of the readings of one encoder at each step, before counts and delay.

    Attributes
    ----------
    offset, std : float
        rad or m.
    noise : WhiteNoise, optional
        Where `std` is above zero.
    late : int
        Steps by which the readings are late.
    """

    offset: float
    std: float
    noise: WhiteNoise | None
    late: int

    @staticmethod
    def of(encoder: Encoder, rate: float, noise: WhiteNoise | None) -> EncoderErrors:
        """Errors at steps of a rate (Hz)."""
        return EncoderErrors(encoder.offset, encoder.noise, noise if encoder.noise else None, encoder.late(rate))

    def at(self, steps: NDArray[np.int64]) -> Array | float:
        """Errors at steps, of a reading without delay."""
        return self.offset if self.noise is None else self.offset + self.std * self.noise.at(steps)


@dataclass
class PositionErrors:
    """A source of what the measured position is off by, tick after tick: a noise of its own, and that of the encoder.

    Attributes
    ----------
    errors : EncoderErrors
    every : int
        Steps per tick.
    added : NoiseSource, optional
        Noise in place of the encoder's.
    tick : int
        The next one.
    """

    errors: EncoderErrors
    every: int
    added: NoiseSource | None
    tick: int = 0

    def block(self, n: int) -> Array:
        """(n,) m, at the next ticks."""
        steps = self.every * np.arange(self.tick, self.tick + n)
        self.tick += n
        return np.zeros(n) + self.errors.at(steps) + (0.0 if self.added is None else self.added.block(n))


@dataclass
class NoiseBuffer:
    """Noise for tick after tick, drawn at least `ahead` values at a time; the block size changes no value."""

    source: NoiseSource | PositionErrors | None
    ahead: int
    drawn: Array = field(default_factory=lambda: np.zeros(0))

    def take(self, count: int) -> Array:
        """Noise (m) of the next ticks; one zero without noise."""
        if self.source is None:
            return np.zeros(1)
        if (missing := count - self.drawn.size) > 0:
            self.drawn = np.concatenate([self.drawn, self.source.block(max(missing, self.ahead))])
        values, self.drawn = self.drawn[:count], self.drawn[count:]
        return values

    def put_back(self, values: Array) -> None:
        """Return noise that was taken for ticks that are still to come."""
        if self.source is not None:
            self.drawn = np.concatenate([values, self.drawn])


@dataclass(frozen=True)
class Readings:
    """Errors of both encoders at the steps of a simulation.

    Attributes
    ----------
    motor : EncoderErrors
        rad.
    position : EncoderErrors
        Of the measured position, m or rad.
    noise : Noise, optional
        On the measured position, in place of its encoder's.
    every : int
        Steps per sample that is recorded.
    """

    motor: EncoderErrors
    position: EncoderErrors
    noise: Noise | None
    every: int

    @staticmethod
    def of(servo: Plant, rate: float, every: int, noise: Noise | None, rng: np.random.Generator) -> Readings | None:
        """Errors at steps of a rate (Hz), of which a sample is `every` long; None: none but counts and `noise`."""
        motor, position = servo.sensors.motor, servo.sensors.fed_back(servo.p)
        if motor.true and position.true:
            return None
        keys = rng.integers(2**62, size=2).tolist()
        ours = WhiteNoise(keys[0])
        # A controller that acts on the motor's encoder measures the position with its very noise.
        load = ours if servo.at_motor else WhiteNoise(keys[1])
        return Readings(
            EncoderErrors.of(motor, rate, ours),
            EncoderErrors.of(position, rate, None if noise is not None else load),
            noise,
            every,
        )

    @property
    def late(self) -> int:
        """Samples by which readings are late, or more."""
        return -(-max(self.motor.late, self.position.late) // self.every)

    @property
    def between_samples(self) -> bool:
        """True where the motor's readings show its angle between two samples, at a tick of the law."""
        return self.motor.late % self.every != 0

    def source(self, tick_rate: float, every: int, rng: np.random.Generator) -> PositionErrors:
        """Errors of the measured position at ticks, which are `every` steps apart."""
        added = None if self.noise is None else self.noise.source(tick_rate, rng)
        return PositionErrors(self.position, every, added)


def motor_readings(
    servo: Plant, readings: Readings | None, channel: Callable[[str, int, int], Array], first: int, last: int
) -> Array:
    """(last - first,) rad, the motor's encoder at samples first .. last - 1; `channel` gives what was simulated.

    NaN where the motor has no encoder.
    """
    if not servo.sensors.motor_encoder:
        return np.full(last - first, np.nan)
    if readings is None or last == first:
        return quantised(channel("theta_m", first, last), servo.encoder_resolution)
    every = readings.every
    steps = np.maximum(every * np.arange(first, last) - readings.motor.late, 0)
    name, unit = (TICKED_MOTOR, 1) if readings.between_samples else ("theta_m", every)
    begin, end = int(steps[0]) // unit, int(steps[-1]) // unit
    angle = channel(name, begin, end + 1)[steps // unit - begin]
    return quantised(angle + readings.motor.at(steps), servo.encoder_resolution)


def chunk_ends(base: int, end: int) -> list[int]:
    """Base steps at which the chunks of a run in noise end."""
    ends, chunk = list[int](), _FIRST_CHUNK
    while base < end:
        base, chunk = min(end, base + chunk), min(chunk + chunk // 2, _LARGEST_CHUNK)
        ends.append(base)
    return ends
