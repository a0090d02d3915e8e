"""Random sampled loops, run by the tick engine and in blocks."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave, Step, as_gap, as_nonnegative, as_pieces
from servotwin.simulation.inputs import RunInputs
from servotwin.simulation.lifted_engine import LiftedEngine
from servotwin.simulation.sampled import SampledEngine

DEGREE = math.pi / 180.0
CHANNELS = ("position", "theta_m", "theta_d", "voltage")


@dataclass
class SampledCase:
    """One loop: servo, sampled controller, inputs, start, number of samples and delay."""

    servo: Servo
    controller: Any
    inputs: RunInputs
    theta_d0: float
    samples: int
    delay: int

    def ticked(self) -> SampledEngine:
        """The run, tick by tick."""
        engine = SampledEngine(
            self.servo,
            self.controller,
            self.inputs,
            self.theta_d0,
            self.samples,
            None,
            np.random.default_rng(0),
            delay=self.delay,
        )
        engine.advance(self.samples - 1)
        return engine

    def noisy(self, std: float, seed: int) -> SampledEngine:
        """The run in white noise (m), tick by tick, not yet begun."""
        noise, rng = Noise(std=std, kind="white"), np.random.default_rng(seed)
        return SampledEngine(
            self.servo, self.controller, self.inputs, self.theta_d0, self.samples, noise, rng, delay=self.delay
        )

    def in_blocks(self) -> LiftedEngine:
        """The run in blocks."""
        engine = LiftedEngine(self.servo, self.controller, self.inputs, self.theta_d0, self.samples, self.delay)
        engine.advance(self.samples - 1)
        return engine

    def nudged(self) -> "SampledCase":
        """The same case with a reference that differs by rounding."""
        inputs = RunInputs(
            self.inputs.reference.scaled(1.0 + 1e-13),
            self.inputs.gap,
            self.inputs.tolerance,
            self.inputs.sample_rate,
            self.inputs.input_bias,
            self.inputs.friction,
        )
        return SampledCase(self.servo, self.controller, inputs, self.theta_d0, self.samples, self.delay)


def random_case(seed: int) -> SampledCase:
    """A servo, a law and inputs drawn from a seed."""
    rng = np.random.default_rng(seed)

    def chance(share: float) -> bool:
        return bool(rng.random() < share)

    servo = Servo.preset(str(rng.choice(["paper", "table1", "paper-gain2"])))
    servo = servo.replace(k=servo.k * rng.uniform(0.8, 1.2), c=servo.c * rng.uniform(0.5, 1.5))
    elastic = chance(0.15)
    if elastic:
        servo = servo.replace(k_d=10.0 ** rng.uniform(5.0, 6.5))
    elif chance(0.2):
        servo = servo.replace(n=2)
    rate = float(rng.choice([50.0, 200.0, 1e3, 2e3, 5e3, 1e4, 2e4]))
    every = int(rng.choice([1, 1, 2, 5]))
    size = 10.0 ** rng.uniform(-4.0, -2.7)
    duration = min(8.0, 25_000 / rate) if rate > 500.0 else 10.0
    law = servo.controller.replace(
        Ki=servo.controller.Ki * float(rng.choice([0.0, 0.3, 1.0])),
        Kp=servo.controller.Kp * rng.uniform(0.5, 1.0),
        sample_rate=rate,
        enter=float(rng.choice([1.0, 0.5])),
        leave=float(rng.choice([1.0, 1.5])),
        loop_filter_hz=rng.uniform(20.0, 0.4 * rate) if chance(0.3) and rate > 100.0 else None,
        voltage_limit=10.0 ** rng.uniform(-0.5, 1.0) if chance(0.35) else None,
        rate_limit=10.0 ** rng.uniform(0.5, 2.5) if chance(0.3) else None,
        feedforward=rng.uniform(-0.05, 0.05) if chance(0.3) else 0.0,
    )
    reference = [
        Step(size, 0.1 * duration * rng.random()),
        SquareWave(size, duration * rng.uniform(0.1, 0.6)),
        SCurve(0.0, size, duration * rng.uniform(0.05, 1.0)),
        PiecewiseCubic(
            [0.0, 0.3 * duration, 0.61803 * duration], [[0, size, 0, 0], [size, -size, 0, 0], [0, 0, 0, 0.0]]
        ),
        size,
    ][int(rng.integers(5))]
    width = float(rng.choice([0.0, 1e-6, 1e-3, 1.0, 10.0, 40.0])) * DEGREE * rng.uniform(0.5, 1.0)
    gap = [
        width,
        width,
        SCurve(0.0, width, duration),
        PiecewiseCubic.zero_order_hold([0.0, 0.31237 * duration, 0.7 * duration], [width, 0.3 * width, 1.1 * width]),
    ][int(rng.integers(4))]
    zone = servo.tolerance_for(10.0 ** rng.uniform(-1.0, 1.2) * DEGREE)
    tolerance = [
        None,
        zone,
        PiecewiseCubic.zero_order_hold([0.0, 0.4 * duration, 0.8 * duration], [zone, 0.0, 2.0 * zone]),
    ][int(rng.integers(3))]
    inputs = RunInputs(
        as_pieces(reference, duration),
        as_gap(gap, duration),
        None if tolerance is None else as_nonnegative(tolerance, duration, "tolerance", "m"),
        rate / every,
        rng.uniform(-0.1, 0.1) if chance(0.4) else 0.0,
        0.05 * servo.k_T / servo.R if chance(0.2) and servo.rigid else 0.0,
    )
    delay = int(rng.choice([0, 0, 1, 2, 3]))
    theta_d0 = rng.uniform(-0.05, 0.05)
    law = law.replace(integral_only=chance(0.4))
    if chance(0.4):
        law = law.replace(velocity_feedforward=rng.uniform(0.2, 0.8) * servo.k_B / servo.p, velocity_time=0.08)
    if chance(0.3):
        law = law.replace(notch_hz=10.0 ** rng.uniform(0.0, 1.5), notch_damping=rng.uniform(0.1, 1.0))
    return SampledCase(servo, law, inputs, theta_d0, int(duration * rate / every) + 1, delay)


def largest_difference(case: SampledCase, one: Any, other: Any) -> float:
    """Largest difference of a channel, as a part of its range."""
    largest = 0.0
    for name in CHANNELS:
        a, b = (engine.channel(name, 0, case.samples) for engine in (one, other))
        assert np.all(np.isfinite(a)), "the run diverges"
        difference = float(np.abs(a - b).max() / max(float(np.abs(a).max()), 1e-300))
        largest = max(largest, difference if math.isfinite(difference) else math.inf)
    return largest
