"""Uncertainty of the model and its conditions, the machines drawn from it, and the region that evidence leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo

Range = tuple[float, float]
_PARAMETERS = ("k", "c", "k_B", "m")
_UNITS = {"gap": "rad", "step": "m", "input_bias": "V", "friction": "N m"}


@settings("uncertainty")
@dataclass(frozen=True)
class Uncertainty:
    """Ranges of a machine's parameters and conditions; within them every value is possible.

    Raises
    ------
    InvalidInput
        A half-width is not in 0 .. 1, or a range is empty, not finite or, but for the bias, negative.
    """

    k: Annotated[
        float, key("k_percent", minimum=0.0, below=1.0, help="Half-width of the stiffness, relative to the model's.")
    ] = 0.15
    c: Annotated[
        float, key("c_percent", minimum=0.0, below=1.0, help="Half-width of the damping, relative to the model's.")
    ] = 0.5
    k_B: Annotated[
        float, key("k_b_percent", minimum=0.0, below=1.0, help="Half-width of the back-EMF, relative to the model's.")
    ] = 0.1
    m: Annotated[
        float, key("m_percent", minimum=0.0, below=1.0, help="Half-width of the mass, relative to the model's.")
    ] = 0.1
    gap: Annotated[Range, key("gap_deg", minimum=0.0, help="Range of the total gap.")] = (0.0, math.radians(60.0))
    step: Annotated[
        Range,
        key(
            "step_mm",
            above=0.0,
            help="Range of the steps that the reference makes; one size is as likely as another on a logarithmic "
            "scale.",
        ),
    ] = (1e-4, 2.5e-3)
    input_bias: Annotated[
        Range, key("input_bias_v", help="Range of the voltage that is added behind the controller.")
    ] = (0.0, 0.0)
    friction: Annotated[
        Range, key("friction_n_m", minimum=0.0, help="Range of the Coulomb friction on the motor's shaft.")
    ] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check(self)
        for name, unit in _UNITS.items():
            low, high = getattr(self, name)
            if not low <= high:
                raise InvalidInput(f"uncertainty {name} = ({low!r}, {high!r}) {unit}: must be in order")

    def replace(self, **changes: object) -> Uncertainty:
        """A copy with some values changed, validated again."""
        unknown = set(changes) - {field.name for field in fields(self)}
        if unknown:
            raise InvalidInput(f"uncertainty has no value named {sorted(unknown)[0]!r}")
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Region:
    """Ranges of a machine's conditions that the evidence allows.

    Attributes
    ----------
    gap : (float, float)
        rad, total.
    feedforward : float
        V, part of the setting.
    input_bias, friction : (float, float)
        V, N m.
    noise : float
        m rms of the measured position; 0 where it is unknown.
    """

    gap: Range
    feedforward: float
    input_bias: Range
    friction: Range
    noise: float

    def within(self, known: Uncertainty) -> Uncertainty:
        """Prior knowledge narrowed to the region."""
        return known.replace(gap=self.gap, input_bias=self.input_bias, friction=self.friction)

    @property
    def largest_bias(self) -> float:
        """Largest sum of input bias and feedforward, V."""
        return max(abs(bias + self.feedforward) for bias in self.input_bias)


@dataclass(frozen=True, eq=False)
class SimulatedMachines:
    """Machines to be simulated: every plant in every one of its conditions.

    Attributes
    ----------
    plants : tuple of P Servo
    gap, step, input_bias, theta_d0, friction : (P, C) array
        rad, m, V, rad, N m.
    """

    plants: tuple[Servo, ...]
    gap: Array
    step: Array
    input_bias: Array
    theta_d0: Array
    friction: Array

    @property
    def count(self) -> int:
        """Number of machines."""
        return self.gap.size


def draw(servo: Servo, uncertainty: Uncertainty, plants: int, conditions: int, seed: int = 0) -> SimulatedMachines:
    """Draw `plants` times `conditions` machines, spread evenly (scrambled Sobol); equal calls draw equal machines.

    The first plant is the model itself. The first two conditions of every plant have the largest and the smallest gap
    and input bias: the ends of an estimate's interval are where a setting fails first.
    """
    conditioned = _sobol(5, plants * conditions, seed + 1).reshape(plants, conditions, 5)
    if conditions > 1:
        conditioned[:, 0, :3:2], conditioned[:, 1, :3:2] = 1.0, 0.0
    gap = _spread(uncertainty.gap, conditioned[..., 0])
    step = np.exp(_spread((math.log(uncertainty.step[0]), math.log(uncertainty.step[1])), conditioned[..., 1]))
    return SimulatedMachines(
        drawn_plants(servo, uncertainty, plants, seed),
        gap,
        step,
        _spread(uncertainty.input_bias, conditioned[..., 2]),
        (conditioned[..., 3] - 0.5) * gap,
        _spread(uncertainty.friction, conditioned[..., 4]),
    )


def drawn_plants(servo: Servo, uncertainty: Uncertainty, count: int, seed: int) -> tuple[Servo, ...]:
    """The model and `count` - 1 plants drawn about it."""
    widths = tuple(getattr(uncertainty, name) for name in _PARAMETERS)
    return _plants(servo, widths, count, seed)


@lru_cache(maxsize=16)
def _plants(servo: Servo, widths: tuple[float, ...], count: int, seed: int) -> tuple[Servo, ...]:
    factors = 1.0 + (2.0 * _sobol(4, count, seed) - 1.0) * np.array(widths)
    factors[0] = 1.0
    return tuple(_scaled(servo, dict(zip(_PARAMETERS, row.tolist(), strict=True))) for row in factors)


def _scaled(servo: Servo, factors: dict[str, float]) -> Servo:
    changes: dict[str, Any] = {}
    for name, factor in factors.items():
        value = getattr(servo, name)
        changes[name] = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
    return servo.replace(**changes)


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    """(count, dimensions) in 0 .. 1."""
    # Here, because scipy.stats takes long to import and many commands never draw machines.
    from scipy.stats import qmc

    # Sobol points are balanced in powers of two only: draw one and keep the first `count`.
    return np.asarray(qmc.Sobol(dimensions, seed=seed).random(2 ** math.ceil(math.log2(max(count, 1))))[:count])


def _spread(ends: Range, places: Array) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * places)
