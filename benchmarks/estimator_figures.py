"""Figures of the estimator's bench, and the windows and noises that its experiments share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.estimator_windows import WindowCase, paper_loop_cases
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.whitened.estimator import WhitenedSettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

Flags: TypeAlias = NDArray[np.bool_]
FLOOR = 1e-6  # m
ANY = (-math.inf, math.inf)
OPEN_MINDED = WhitenedSettings(largest_std=10.0, largest_shift=10.0)  # refuses next to nothing


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes
    ----------
    name : str
        What was measured, with its unit.
    value : float
    target : (float, float)
        Between what it must lie; (-inf, inf) where it is only reported.
    windows : int
    remark : str
    """

    name: str
    value: float
    target: tuple[float, float]
    windows: int
    remark: str = ""

    @property
    def met(self) -> bool:
        """True: the value lies within its limits."""
        return self.target[0] <= self.value <= self.target[1]


@dataclass(frozen=True, eq=False)
class Answers:
    """Estimates of some cases, accepted or not."""

    cases: Sequence[WindowCase]
    estimates: Sequence[GapEstimate]

    @property
    def accepted(self) -> Flags:
        """(n,) bool: the estimate is OK."""
        return np.array([estimate.ok for estimate in self.estimates], dtype=bool)

    @property
    def errors(self) -> Array:
        """(n,) errors, deg; NaN where refused."""
        pairs = zip(self.cases, self.estimates, strict=True)
        return np.array([math.degrees(e.gap - c.gap) if e.ok else math.nan for c, e in pairs])

    def coverage(self, spread: str = "std") -> float:
        """Share of the accepted errors within 1.96 `spread`."""
        stds = np.degrees([getattr(estimate, spread) for estimate in self.estimates])
        ratio = np.abs(self.errors)[self.accepted] / stds[self.accepted]
        return float(np.mean(ratio <= NORMAL_95)) if ratio.size else math.nan


def answers(
    cases: Iterable[WindowCase], servo: Servo | None = None, settings: WhitenedSettings | None = None
) -> Answers:
    """Run the default estimator on all cases, with another model where one is given."""
    known = list(cases)
    return Answers(known, [estimate_gap(c.window, servo or c.servo, settings=settings) for c in known])


def eight_gaps() -> Array:
    """Eight gaps from 4 to 18 deg, rad."""
    return np.radians(np.linspace(4.0, 18.0, 8))


def clean_cases(per_gap: int, seed: int) -> list[WindowCase]:
    """Windows of the paper's loop without noise."""
    return paper_loop_cases(eight_gaps(), per_gap, seed, None)


def on_floor(case: WindowCase, floor: float, rng: np.random.Generator) -> WindowCase:
    """A case with white noise of `floor` (m)."""
    return case.noisy(floor * rng.standard_normal(case.window.position.size))
