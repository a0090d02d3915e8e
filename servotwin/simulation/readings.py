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
    """A source of what the measured position is off by, step after step: a noise of its own, and that of the encoder.

    Attributes
    ----------
    errors : EncoderErrors
    added : NoiseSource, optional
        Noise in place of the encoder's.
    step : int
        The next one.
    """

    errors: EncoderErrors
    added: NoiseSource | None
    step: int = 0

    def block(self, n: int) -> Array:
        """(n,) m, at the next steps."""
        steps = np.arange(self.step, self.step + n)
        self.step += n
        return np.zeros(n) + self.errors.at(steps) + (0.0 if self.added is None else self.added.block(n))


@dataclass
class NoiseBuffer:
    """Noise for tick after tick, drawn at least `ahead` values at a time; the block size changes no value.

    Attributes
    ----------
    source : NoiseSource or PositionErrors, optional
        None: no noise.
    ahead : int
        Values.
    every : int
        Steps per tick. The source has a value for each step, and `at` repeats those of the ticks that were taken.
    """

    source: NoiseSource | PositionErrors | None
    ahead: int
    every: int = 1
    drawn: Array = field(default_factory=lambda: np.zeros(0))
    _taken: Array = field(default_factory=lambda: np.zeros(0))
    _first: int = 0
    _end: int = 0

    def take(self, count: int) -> Array:
        """Noise (m) of the next ticks; one zero without noise."""
        if self.source is None:
            return np.zeros(1)
        self._draw(count * self.every)
        values, self.drawn = np.split(self.drawn, [count * self.every])
        if self.every > 1:
            self._remember(values)
        return values[:: self.every]

    def next(self) -> float:
        """Noise (m) of the next tick, which stays the next one."""
        if self.source is None:
            return 0.0
        self._draw(1)
        return float(self.drawn[0])

    def put_back(self, values: Array) -> None:
        """Return noise that was taken for ticks that are still to come, of one step each."""
        if self.source is not None:
            self.drawn = np.concatenate([values, self.drawn])

    def at(self, steps: NDArray[np.int64]) -> Array:
        """Noise (m) at steps from the last one that was forgotten on."""
        return np.zeros(steps.size) if self.source is None else self._taken[steps - self._first]

    def forget(self, step: int) -> None:
        """Drop what came before a step."""
        if self.every > 1 and self.source is not None:
            self._taken = self._taken[step - self._first : self._end - self._first]
            self._first = step

    def _draw(self, count: int) -> None:
        assert self.source is not None
        if (missing := count - self.drawn.size) > 0:
            self.drawn = np.concatenate([self.drawn, self.source.block(max(missing, self.ahead))])

    def _remember(self, values: Array) -> None:
        used, self._end = self._end - self._first, self._end + values.size
        if self._end - self._first > self._taken.size:
            self._taken = np.concatenate([self._taken[:used], np.empty(used + values.size)])
        self._taken[used : self._end - self._first] = values


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

    def source(self, rate: float, rng: np.random.Generator) -> PositionErrors:
        """Errors of the measured position at steps of a rate (Hz)."""
        return PositionErrors(self.position, None if self.noise is None else self.noise.source(rate, rng))


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
