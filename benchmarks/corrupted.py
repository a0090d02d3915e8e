"""Windows of machines and sensors that are not as assumed: 27 kinds of corruption, and clean windows beside them.

Every window has 1 um of white noise on the position, whatever else is wrong with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from benchmarks.estimator_windows import RATE, WindowCase, cut, random_servo
from benchmarks.wrong_models import ModelError
from servotwin.errors import InvalidInput
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SCurve, SquareWave
from servotwin.simulation import Run, simulate

Random = np.random.Generator
Plant = Callable[[Random, Servo], Servo]
Fault = Callable[[Random, Array], Array]

LARGEST = math.radians(40.0)
NOISE = 1e-6  # m
_CALM = 0.4  # share of calm loops
_GROWN_S = 40.0  # s: a ramp is the middle of an S-curve of this length and more
_DEGREE = math.pi / 180.0


def _model(k: float, c: float, pitch: float = 0.0) -> Plant:
    return lambda rng, servo: ModelError(k, c, pitch).machine(rng, servo)


def _first_spring(_rng: Random, servo: Servo) -> Servo:
    return servo.replace(k=(1.1 * servo.stiffnesses[0], *servo.stiffnesses[1:]))


def _last_mass(_rng: Random, servo: Servo) -> Servo:
    return servo.replace(m=(*servo.masses[:-1], 1.15 * servo.masses[-1]))


def _soft_screw(rng: Random, servo: Servo) -> Servo:
    return servo.replace(k_d=float(servo.stiffnesses.max()) * float(rng.uniform(5.0, 50.0)))


def _counts(step: float) -> Fault:
    return lambda _rng, values: step * np.round(values / step)


def _noise(std: float) -> Fault:
    return lambda rng, values: values + rng.normal(0.0, std, values.size)


def _late(samples: int) -> Fault:
    return lambda _rng, values: np.concatenate([np.full(samples, values[0]), values[:-samples]])


def _scaled(factor: float) -> Fault:
    return lambda _rng, values: factor * values


def _drifting(size: float) -> Fault:
    return lambda _rng, values: values + np.linspace(0.0, size, values.size)


def _humming(size: float, hertz: float) -> Fault:
    return lambda _rng, values: values + size * np.sin(2.0 * np.pi * hertz / RATE * np.arange(values.size))


def _spiked(rng: Random, values: Array) -> Array:
    spiked = values.copy()
    spiked[rng.integers(0, values.size, 5)] += 0.2 * np.ptp(values) * rng.normal(0.0, 1.0, 5)
    return spiked


def _held(rng: Random, values: Array) -> Array:
    stuck, first = values.copy(), int(rng.integers(100, values.size - 300))
    stuck[first : first + int(rng.integers(5, 60))] = stuck[first]
    return stuck


def _lagging(seconds: float) -> Fault:
    decay = math.exp(-1.0 / (RATE * seconds))
    return lambda _rng, values: values[0] + lfilter([1.0 - decay], [1.0, -decay], values - values[0])


def _cyclic(size: float) -> Fault:
    return lambda _rng, values: values + size * np.sin(values)


@dataclass(frozen=True)
class Corruption:
    """What is wrong: the plant, a ramp of the gap (rad/s), position, angle, or a position that errs with the angle."""

    plant: Plant | None = None
    ramp: float = 0.0
    position: Fault | None = None
    angle: Fault | None = None
    cyclic: float = 0.0

    def machine(self, rng: Random, model: Servo) -> Servo:
        """Draw the plant behind a model."""
        return model if self.plant is None else self.plant(rng, model)

    def corrupted(self, rng: Random, window: Window) -> Window:
        """Corrupt the channels of a window."""
        assert window.theta_m is not None
        position, angle = window.position + self.cyclic * np.sin(window.theta_m), window.theta_m
        if self.position is not None:
            position = self.position(rng, position)
        return window.replace(position=position, theta_m=angle if self.angle is None else self.angle(rng, angle))


KINDS: Mapping[str, Corruption] = {
    "clean": Corruption(),
    "k 2 %, c 30 %": Corruption(_model(0.02, 0.3)),
    "k 5 %, c 50 %": Corruption(_model(0.05, 0.5)),
    "c 10 %": Corruption(_model(0.0, 0.1)),
    "pitch 1 %": Corruption(_model(0.0, 0.0, 0.01)),
    "first spring 10 %": Corruption(_first_spring),
    "last mass 15 %": Corruption(_last_mass),
    "soft screw": Corruption(_soft_screw),
    "ramp of 0.5 deg/s": Corruption(ramp=0.5 * _DEGREE),
    "ramp of 2 deg/s": Corruption(ramp=2.0 * _DEGREE),
    "position in 5 um": Corruption(position=_counts(5e-6)),
    "position in 50 um": Corruption(position=_counts(5e-5)),
    "angle in 0.1 deg": Corruption(angle=_counts(0.1 * _DEGREE)),
    "angle in 1 deg": Corruption(angle=_counts(_DEGREE)),
    "angle's noise 0.05 deg": Corruption(angle=_noise(0.05 * _DEGREE)),
    "position 0.6 ms late": Corruption(position=_late(3)),
    "position 3 ms late": Corruption(position=_late(15)),
    "position's scale 2 %": Corruption(position=_scaled(1.02)),
    "position drifts": Corruption(position=_drifting(2e-5)),
    "hum of 50 Hz": Corruption(position=_humming(5e-6, 50.0)),
    "hum of 3 Hz": Corruption(position=_humming(5e-6, 3.0)),
    "spikes": Corruption(position=_spiked),
    "position held": Corruption(position=_held),
    "angle held": Corruption(angle=_held),
    "position lags 3 ms": Corruption(position=_lagging(3e-3)),
    "angle lags 3 ms": Corruption(angle=_lagging(3e-3)),
    "position cyclic 5 um": Corruption(cyclic=5e-6),
    "angle cyclic 0.2 deg": Corruption(angle=_cyclic(0.2 * _DEGREE)),
}


def corrupted_windows(kind: str, count: int, seed: int) -> Iterator[WindowCase]:
    """Draw `count` windows of a kind from any servo, loop, gap and motion; the model is the uncorrupted servo."""
    corruption = KINDS[kind]
    rng, made = np.random.default_rng([seed, list(KINDS).index(kind)]), 0
    while made < count:
        model = random_servo(rng)
        calm = bool(rng.random() < _CALM)
        try:
            run = _run(rng, model, corruption, calm)
        except InvalidInput:
            continue  # a plant whose loop is unstable without a gap
        for start in (14.7,) if calm else rng.uniform(0.5, 18.8, 2)[: count - made]:
            case = cut(run, float(start), 2.0 if calm else 1.0, f"{model.n} masses, {'calm' if calm else 'worn'} loop")
            noisy = case.noisy(rng.normal(0.0, NOISE, case.window.position.size))
            yield noisy.replaced(corruption.corrupted(rng, noisy.window), model)
            made += 1


def _run(rng: Random, model: Servo, corruption: Corruption, calm: bool) -> Run:
    plant = corruption.machine(rng, model)
    plant.check_loop()
    law, gap = model.controller, float(rng.uniform(0.3 * _DEGREE, LARGEST))
    if calm:
        part = float(rng.uniform(0.6, 1.0))
        law = law.replace(Ki=0.0, Kp=part * law.Kp, Kd=part * law.Kd)
    return simulate(
        plant,
        32.0 if calm else 20.0,
        controller=law,
        reference=SquareWave(
            math.exp(rng.uniform(math.log(2e-4), math.log(2.5e-3))), 30.0 if calm else rng.uniform(6, 16)
        ),
        gap=SCurve(gap, gap + corruption.ramp * _GROWN_S, _GROWN_S) if corruption.ramp else gap,
        theta_d0=float(rng.uniform(-0.5, 0.5)) * gap,
        tolerance=None,
    )
