"""Uncertainty of the model and its conditions, and the region that evidence leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Protocol

import numpy as np

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.own_units import INPUT_BIAS_KEYS
from servotwin.plant.plants import Plant

Range = tuple[float, float]
LARGEST_DELAY = 64
"""Longest delay that is simulated, samples."""
PARAMETERS = ("k", "c", "k_B", "m", "k_T", "p")
"""Numbers of the plant that are uncertain, in the order of the drawn factors."""
# Standard deviations beyond which a learnt factor is not drawn.
_TAILS = 3.0


@dataclass(frozen=True)
class LearntFactors:
    """Posterior of plant parameters, as a normal distribution of the logarithms of their factors on the model's values.

    Attributes
    ----------
    names : tuple of N str
        Of `PARAMETERS`.
    mean : tuple of N float
    covariance : tuple of N tuples of N float
    per_mass : bool
        True where the stiffness is that over the mass: it is drawn times the mass's factor.

    Raises
    ------
    InvalidInput
        A name is unknown or comes twice, or the covariance is not symmetric, positive semidefinite and of that size.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    # Not in the representation, which seeds the verification: a servo's factors always have the same one.
    per_mass: bool = field(default=False, repr=False)

    def __post_init__(self) -> None:
        if len(set(self.names)) < len(self.names) or not set(self.names) <= set(PARAMETERS):
            raise InvalidInput(f"learnt factors of {self.names!r}: each must be one of {', '.join(PARAMETERS)}, once")
        matrix, size = np.array(self.covariance, dtype=float), len(self.names)
        if matrix.shape != (size, size) or len(self.mean) != size or not np.isfinite(matrix).all():
            raise InvalidInput(f"learnt factors: {size} names need {size} means and a covariance of {size} by {size}")
        values = np.linalg.eigvalsh(matrix) if size else np.zeros(1)
        if not np.allclose(matrix, matrix.T) or values[0] < -1e-9 * max(float(values[-1]), 1e-300):
            raise InvalidInput("learnt factors: the covariance must be symmetric and positive semidefinite")

    def factors(self, places: Array) -> Array:
        """(count, N) factors for (count, N) places in 0 .. 1, at most three standard deviations off."""
        from scipy.special import ndtri

        values, vectors = np.linalg.eigh(np.array(self.covariance))
        normal = np.clip(ndtri(np.clip(places, 1e-12, 1.0 - 1e-12)), -_TAILS, _TAILS)
        return np.asarray(np.exp(np.array(self.mean) + normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T))


class StatedRanges(Protocol):
    """Ranges of a machine's conditions: gap (rad), input bias (command), step (m or rad) and friction (N m)."""

    @property
    def gap(self) -> Range: ...
    @property
    def input_bias(self) -> Range: ...
    @property
    def step(self) -> Range: ...
    @property
    def friction(self) -> Range: ...


def in_words(ranges: StatedRanges, plant: Plant) -> str:
    """Say the ranges in the units of a plant."""
    unit, command = position_unit(plant), command_unit(plant)
    low, high = (math.degrees(end) for end in ranges.gap)
    return (
        f"steps of {unit.factor * ranges.step[0]:.3g} to {unit.factor * ranges.step[1]:.3g} {unit.name} from rest, "
        f"gaps of {low:.4g} to {high:.4g} deg at the motor, input bias of {ranges.input_bias[0]:.3g} to "
        f"{ranges.input_bias[1]:.3g} {command}, friction of {ranges.friction[0]:.3g} to {ranges.friction[1]:.3g} N m"
    )


@settings("uncertainty")
@dataclass(frozen=True)
class Uncertainty:
    """Ranges of a machine's parameters and conditions; within them every value is possible.

    Parameters
    ----------
    learnt : LearntFactors, optional
        Posterior of some parameters, which counts in place of their half-widths.
    usual_step : (float, float), optional
        m, sizes of the steps that the machine was seen to make: settings are compared by their cost on these, and
        verified on all of `step`.

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
    gap: Annotated[Range, key("gap_deg", minimum=0.0, ordered=True, at_load=True, help="Range of the total gap.")] = (
        0.0,
        math.radians(60.0),
    )
    step: Annotated[
        Range,
        key(
            "step_mm",
            "step_deg",
            above=0.0,
            ordered=True,
            help="Range of the steps that the reference makes; one size is as likely as another on a logarithmic "
            "scale.",
        ),
    ] = (1e-4, 2.5e-3)
    input_bias: Annotated[
        Range,
        key(
            *INPUT_BIAS_KEYS,
            ordered=True,
            help="Range of the command that is added behind the controller; where a twin's file leaves it out, up to "
            "0.1 V either way, and of an axis as much in its own units, at most 1 % of its command's limit.",
        ),
    ] = (0.0, 0.0)
    friction: Annotated[
        Range,
        key("friction_n_m", minimum=0.0, ordered=True, help="Range of the Coulomb friction on the motor's shaft."),
    ] = (0.0, 0.0)
    k_T: Annotated[
        float,
        key("k_t_percent", minimum=0.0, below=1.0, help="Half-width of the torque gain, relative to the model's."),
    ] = 0.0
    p: Annotated[
        float, key("pitch_percent", minimum=0.0, below=1.0, help="Half-width of the pitch, relative to the model's.")
    ] = 0.0
    delay: Annotated[
        int,
        key(
            "delay_samples",
            minimum=0,
            maximum=LARGEST_DELAY,
            help="Longest delay between a measurement and its voltage, of a sampled controller.",
        ),
    ] = 0
    learnt: LearntFactors | None = None
    # Not in the representation, which seeds the verification: a servo has no friction of its own, and its machines are
    # always the same ones.
    own_friction: Annotated[
        float,
        key(
            "own_friction_percent",
            minimum=0.0,
            below=1.0,
            help="Half-width of the friction that an axis states, of its motor and of its load, relative to it.",
        ),
    ] = field(default=0.25, repr=False)
    # Likewise: its machines do not depend on this.
    usual_step: Range | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check(self)

    def own_friction_of(self, plant: Plant) -> Range:
        """Range of the friction at standstill that a model states, as a torque on the motor, N m."""
        least, most = 1.0 - self.own_friction, 1.0 + self.own_friction
        return least * plant.own_friction, most * plant.own_friction

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
    usual_step : (float, float), optional
        m, sizes of the last steps; None: none was seen.
    """

    gap: Range
    feedforward: float
    input_bias: Range
    friction: Range
    noise: float
    usual_step: Range | None = None

    def within(self, known: Uncertainty) -> Uncertainty:
        """Prior knowledge narrowed to the region."""
        return known.replace(
            gap=self.gap, input_bias=self.input_bias, friction=self.friction, usual_step=self.usual_step
        )

    @property
    def largest_bias(self) -> float:
        """Largest sum of input bias and feedforward, V."""
        return max(abs(bias + self.feedforward) for bias in self.input_bias)
