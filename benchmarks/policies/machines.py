"""Random machines for policies: four blocks, each with one kind of disturbance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.uncertainty import Uncertainty

BLOCKS = ("clean", "bias", "friction", "noise")
BIAS = 0.1  # V, largest; friction's torque is at most what this voltage stalls
NOISE = Noise(0.22e-3)
_RELATIVE = ("k", "c", "k_B", "m")


@dataclass(frozen=True)
class TrialMachine:
    """One plant with its gap, disturbances and reference step.

    Attributes
    ----------
    servo : Servo
        The plant as it is; policies know the model only.
    gap, theta_d0 : float
        rad.
    step : float
        m.
    input_bias, friction : float
        V, N m.
    seed : int
        Of its own randomness.
    """

    servo: Servo
    gap: float
    theta_d0: float
    step: float
    input_bias: float
    friction: float
    seed: int


def machines(model: Servo, known: Uncertainty, block: str, count: int, seed: int) -> list[TrialMachine]:
    """`count` machines of a block: parameters, gap and bias uniform within what is `known`, steps logarithmic."""
    rng = np.random.default_rng([seed, BLOCKS.index(block)])
    return [_machine(model, known, block, rng, seed * 100_000 + k) for k in range(count)]


def _machine(model: Servo, known: Uncertainty, block: str, rng: np.random.Generator, seed: int) -> TrialMachine:
    widths = {name: getattr(known, name) for name in _RELATIVE}
    servo = model.replace(**{n: getattr(model, n) * (1.0 + w * rng.uniform(-1.0, 1.0)) for n, w in widths.items()})
    gap = rng.uniform(*known.gap)
    bias = rng.uniform(-BIAS, BIAS)
    return TrialMachine(
        servo,
        gap,
        rng.uniform(-0.5, 0.5) * gap,
        math.exp(rng.uniform(*np.log(known.step))),
        bias if block == "bias" else 0.0,
        abs(bias) * servo.k_T / servo.R if block == "friction" else 0.0,
        seed,
    )
