"""Simulated machines, drawn from the uncertainty of a model and its conditions."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.sobol import sobol
from servotwin.redesign.certified.uncertainty import PARAMETERS, Range, Uncertainty

# Drawn after the parameters, where a model states friction.
_FRICTIONS = ("motor_friction", "load_friction")
_LEAST_GAP = 1e-6  # of the smallest step
_DRAWN_CONDITIONS = 6  # all but the direction, which takes turns
_CONDITION_NAMES = ("gap", "step", "input_bias", "theta_d0", "friction", "delay", "direction")


@dataclass(frozen=True, eq=False)
class SimulatedMachines:
    """Machines to be simulated: every plant in every one of its conditions.

    Attributes
    ----------
    plants : tuple of P Servo or Axis
    gap, step, input_bias, theta_d0, friction, delay : (P, C) array
        rad, m, V, rad, N m, samples.
    direction : (P, C) array
        Of the step: 1, or by turns 1 and -1 where a bias or a force pushes one way.
    whole : SimulatedMachines, optional
        Those that these are a part of.
    """

    plants: tuple[Plant, ...]
    gap: Array
    step: Array
    input_bias: Array
    theta_d0: Array
    friction: Array
    delay: Array
    direction: Array
    whole: SimulatedMachines | None = None

    @property
    def model(self) -> Plant:
        """The servo in whose units errors are judged: the first of all machines."""
        return self.plants[0] if self.whole is None else self.whole.model

    @cached_property
    def own_friction(self) -> Array:
        """(P, 1) N m, friction at standstill that the plants have beside `friction`."""
        return np.array([[plant.own_friction] for plant in self.plants])

    @property
    def count(self) -> int:
        """Number of machines."""
        return self.gap.size

    def part(self, first: int, last: int) -> SimulatedMachines:
        """Machines of some of the plants."""
        conditions = {name: getattr(self, name)[first:last] for name in _CONDITION_NAMES}
        return SimulatedMachines(self.plants[first:last], **conditions, whole=self)

    def each(self, places: NDArray[np.int64]) -> SimulatedMachines:
        """Machines at flat places, each a plant in one condition."""
        conditions = {name: getattr(self, name).ravel()[places, None] for name in _CONDITION_NAMES}
        plants = tuple(self.plants[place // self.gap.shape[1]] for place in places)
        return SimulatedMachines(plants, **conditions, whole=self)


def draw(servo: Plant, uncertainty: Uncertainty, plants: int, conditions: int, seed: int = 0) -> SimulatedMachines:
    """Draw `plants` times `conditions` machines, spread evenly (scrambled Sobol); equal calls draw equal machines.

    The first plant is the model itself. The first two conditions of every plant have the largest and the smallest gap
    and input bias: the ends of an estimate's interval are where a setting fails first.
    """
    places = _sobol(_DRAWN_CONDITIONS, plants * conditions, seed + 1).reshape(plants, conditions, _DRAWN_CONDITIONS)
    if conditions > 1:
        places[:, 0, :3:2], places[:, 1, :3:2] = 1.0, 0.0
    return _machines(drawn_plants(servo, uncertainty, plants, seed), uncertainty, places)


def draw_independently(servo: Plant, uncertainty: Uncertainty, count: int, seed: int) -> SimulatedMachines:
    """Draw `count` machines independently of one another, each a plant of its own in one condition.

    Shares of such machines are binomial, which those of an even spread are not.
    """
    rng = np.random.default_rng(seed)
    factors = _factors(uncertainty, rng.random((count, len(_drawn(servo)))))
    return _machines(_scaled_plants(servo, factors), uncertainty, rng.random((count, 1, _DRAWN_CONDITIONS)))


def drawn_plants(servo: Plant, uncertainty: Uncertainty, count: int, seed: int) -> tuple[Plant, ...]:
    """The model and `count` - 1 plants drawn about it."""
    return _plants(servo, parameters_of(uncertainty), count, seed)


def parameters_of(uncertainty: Uncertainty) -> Uncertainty:
    """Uncertainty of the plant alone, equal for all conditions."""
    return Uncertainty(
        **{name: getattr(uncertainty, name) for name in (*PARAMETERS, "own_friction")},
        delay=uncertainty.delay,
        learnt=uncertainty.learnt,
    )


def extreme_plants(servo: Plant, uncertainty: Uncertainty, more: int, seed: int) -> tuple[Plant, ...]:
    """The model, every corner of the parameters' ranges, and `more` plants within.

    Corners of learnt parameters are two standard deviations off along each axis of their covariance.
    """
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=len(PARAMETERS))))
    learnt = uncertainty.learnt
    if learnt is not None:
        # Places of plus and minus two standard deviations of a normal distribution.
        which = [PARAMETERS.index(name) for name in learnt.names]
        corners[:, which] = np.where(corners[:, which] > 0.5, 0.97725, 0.02275)
    factors = _factors(uncertainty, np.concatenate([corners, _sobol(len(PARAMETERS), more, seed)]))
    return (servo, *_scaled_plants(servo, np.unique(factors, axis=0)))


@lru_cache(maxsize=16)
def _plants(servo: Plant, uncertainty: Uncertainty, count: int, seed: int) -> tuple[Plant, ...]:
    factors = _factors(uncertainty, _sobol(len(_drawn(servo)), count, seed))
    factors[0] = 1.0
    return _scaled_plants(servo, factors)


def _drawn(plant: Plant) -> tuple[str, ...]:
    """Names of the factors of a plant's machines."""
    return (*PARAMETERS, *_FRICTIONS) if plant.own_friction else PARAMETERS


def _factors(uncertainty: Uncertainty, places: Array) -> Array:
    """(count, N) factors on the model's values for places in 0 .. 1, of the parameters or of all that is drawn."""
    names = (*PARAMETERS, *("own_friction" for _ in _FRICTIONS))[: places.shape[1]]
    factors = 1.0 + (2.0 * places - 1.0) * np.array([getattr(uncertainty, name) for name in names])
    learnt = uncertainty.learnt
    if learnt is not None and learnt.names:
        which = [PARAMETERS.index(name) for name in learnt.names]
        factors[:, which] = learnt.factors(places[:, which])
        if learnt.per_mass and "k" in learnt.names:
            factors[:, PARAMETERS.index("k")] *= factors[:, PARAMETERS.index("m")]
    return np.asarray(factors)


def _machines(plants: tuple[Plant, ...], uncertainty: Uncertainty, places: Array) -> SimulatedMachines:
    """Machines of plants for (P, C, conditions) places in 0 .. 1."""
    low, high = uncertainty.gap
    if plants[0].backlash_kind is BacklashKind.FREE:
        # A shaft without any gap changes its flank without end wherever its torque changes sign.
        least = _LEAST_GAP * uncertainty.step[0] / plants[0].p
        low, high = max(low, least), max(high, least)
    gap = _spread((low, high), places[..., 0])
    step = np.exp(_spread((math.log(uncertainty.step[0]), math.log(uncertainty.step[1])), places[..., 1]))
    return SimulatedMachines(
        plants,
        gap,
        step,
        _spread(uncertainty.input_bias, places[..., 2]),
        (places[..., 3] - 0.5) * gap,
        _spread(uncertainty.friction, places[..., 4]),
        np.minimum(np.floor(places[..., 5] * (uncertainty.delay + 1)), uncertainty.delay),
        _directions(plants[0], uncertainty, gap.shape),
    )


def _directions(model: Plant, uncertainty: Uncertainty, shape: tuple[int, ...]) -> Array:
    """Directions of the steps: one stands for both where nothing tells them apart."""
    low, high = uncertainty.input_bias
    if low == -high and model.guide.force == 0.0:
        return np.ones(shape)
    return np.asarray(1.0 - 2.0 * (np.indices(shape).sum(axis=0) % 2))


def _scaled_plants(servo: Plant, factors: Array) -> tuple[Plant, ...]:
    names = (*PARAMETERS, *_FRICTIONS)[: factors.shape[1]]
    return tuple(servo.scaled(dict(zip(names, row, strict=True))) for row in factors.tolist())


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    """(count, dimensions) in 0 .. 1."""
    # Sobol points are balanced in powers of two only: draw one and keep the first `count`.
    return sobol(dimensions, math.ceil(math.log2(max(count, 1))), seed)[:count]


def _spread(ends: Range, places: Array) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * places)
