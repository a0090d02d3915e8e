"""Windows of the paper's loop on which the default estimator is tested, and its error on them."""

import math
from functools import lru_cache

import numpy as np

from benchmarks.estimator_windows import WindowCase, paper_loop_cases
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

SERVO = Servo.preset("paper")
FLOOR = 1e-6


@lru_cache
def clean() -> tuple[WindowCase, ...]:
    return tuple(paper_loop_cases(np.radians([4.0, 9.0, 18.0]), 3, 5, None))


def measured(case: WindowCase, seed: int = 1, floor: float = FLOOR) -> Window:
    rng = np.random.default_rng(seed)
    return case.noisy(floor * rng.standard_normal(case.window.position.size)).window


def error(estimate: GapEstimate, case: WindowCase) -> float:
    assert estimate.ok, (estimate, case.words)
    return math.degrees(estimate.gap - case.gap)


def failures(figures) -> list:
    return [figure for figure in figures if not figure.met]
