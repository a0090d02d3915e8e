"""Scores of many windows of the paper's loop, closed on its noise: what sequences are drawn from."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from benchmarks.estimator_figures import FLOOR
from servotwin.analysis.maps.pool import shared
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened.free_model import adapted
from servotwin.estimation.whitened.quick import quick_fit
from servotwin.estimation.window import Window
from servotwin.novelty.score import model_of, score
from servotwin.novelty.settings import NoveltyModel
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SquareWave
from servotwin.simulation import simulate
from servotwin.twin.estimating import estimator_of
from servotwin.twin.settings import TwinSettings

RATE, SECONDS = 5000.0, 1.0
STEP, AMPLITUDE = 5.0, 1e-3  # s from one change of the reference to the next, m
CHUNK = 20  # windows of one run
KNOWN_GAP = math.radians(10.0)


@dataclass(frozen=True)
class NoveltyCondition:
    """What the machine is beside what the edge takes it for.

    Attributes
    ----------
    name : str
    noise : Noise or None
        On the measured position, in the loop; a white floor of 1 um comes on top.
    k, c, pitch : float
        Stiffness, damping and pitch of the machine over those of the model in the edge's file.
    learnt : int
        Windows from which the twin has learnt the machine before it sent its response to the edge; 0: none.
    """

    name: str
    noise: Noise | None
    k: float = 1.0
    c: float = 1.0
    pitch: float = 1.0
    learnt: int = 0


PAPER_NOISE = Noise(0.22e-3)
CONDITIONS = (
    NoveltyCondition("paper's noise", PAPER_NOISE),
    NoveltyCondition("paper's noise, k + 1 %, c + 20 %", PAPER_NOISE, 1.01, 1.2),
    NoveltyCondition("1 um", None),
    NoveltyCondition("1 um, k + 1 %, c + 20 %", None, 1.01, 1.2),
    NoveltyCondition("paper's noise, k + 1 %, c + 20 %, learnt", PAPER_NOISE, 1.01, 1.2, learnt=3),
    NoveltyCondition("1 um, k + 1 %, c + 20 %, learnt", None, 1.01, 1.2, learnt=3),
    NoveltyCondition("paper's noise, k + 5 %, c + 30 %, pitch + 1 %, learnt", PAPER_NOISE, 1.05, 1.3, 1.01, 3),
    NoveltyCondition("1 um, k + 5 %, c + 30 %, pitch + 1 %, learnt", None, 1.05, 1.3, 1.01, 3),
)


class PoolTask(NamedTuple):
    """So many windows of one machine at a gap (rad)."""

    condition: NoveltyCondition
    gap: float
    seed: int


@dataclass(frozen=True, eq=False)
class ScorePool:
    """Scores at one gap, those after steps up and those after steps down.

    Attributes
    ----------
    gap : float
        rad, the true one.
    scores : (2, n, 2) array
        Estimate and standard deviation, rad.
    silent : int
        Windows that do not show the gap.
    """

    gap: float
    scores: Array
    silent: int

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """(count, 2) with replacement, steps up and down in turns."""
        which = rng.integers(0, self.scores.shape[1], count)
        return np.asarray(self.scores[np.arange(count) % 2, which])


def pools(condition: NoveltyCondition, gaps: Sequence[float], counts: Sequence[int], seed: int) -> Iterator[ScorePool]:
    """One pool for each gap (rad), of at least so many windows."""
    tasks = [
        PoolTask(condition, gap, seed + 1000 * place + chunk)
        for place, (gap, count) in enumerate(zip(gaps, counts, strict=True))
        for chunk in range(-(-count // CHUNK))
    ]
    results = dict(shared(scored, tasks))
    for gap in gaps:
        rows = [row for task in tasks if task.gap == gap for row in results[task]]
        informative = [[s[1:] for s in rows if s[0] == way and math.isfinite(s[1])] for way in (0, 1)]
        few = min(map(len, informative))
        yield ScorePool(gap, np.array([way[:few] for way in informative]), len(rows) - sum(map(len, informative)))


def scored(task: PoolTask) -> list[tuple[int, float, float]]:
    """Score each window: direction of the step before it, estimate, standard deviation; NaN where it shows no gap."""
    known = Servo.preset("paper")
    (model, gap_std), rng = edge_model(task.condition), np.random.default_rng(task.seed)
    rows = []
    for number, window in enumerate(_with_floor(recorded(task, known), rng)):
        assert window.theta_m is not None
        estimate = score(array("d", window.theta_m), array("d", window.position), model, KNOWN_GAP)
        found = (math.nan, math.nan) if estimate is None else (estimate.gap, math.hypot(estimate.std, gap_std))
        rows.append((number % 2, *found))
    return rows


def _with_floor(windows: Iterator[Window], rng: np.random.Generator) -> Iterator[Window]:
    for window in windows:
        yield window.replace(position=window.position + FLOOR * rng.standard_normal(window.position.size))


@lru_cache
def edge_model(condition: NoveltyCondition) -> tuple[NoveltyModel, float]:
    """The edge's model, with the spread (rad) of a gap that is open in it: as configured, or as the twin has learnt."""
    known, settings = Servo.preset("paper"), TwinSettings()
    model, wear, left, gap_std = model_of(known, RATE), Wear(0.0), condition.learnt, 0.0
    estimator, task = estimator_of(known, settings), PoolTask(condition, KNOWN_GAP, 1)
    for window in _with_floor(recorded(task, known), np.random.default_rng(1)):
        if left == 0:
            break
        now = window.mid_time
        expected = wear.expect(settings.trend, "b", now, now, settings.learning)
        estimate = estimator(window, expected)
        wear, rejection = wear.update(settings.trend, "b", estimate, now, settings.learning)
        machine = wear.known_machine(settings.learning, now)
        if machine is not None and not rejection and estimate.machine is not None:
            left -= 1
            gap_std = quick_fit(window, known, estimate.gap, None, machine).machine_spread().gap
            model = model_of(adapted(known, machine.mean), RATE)
    return model, gap_std


def recorded(task: PoolTask, known: Servo) -> Iterator[Window]:
    """Yield the windows after the steps of one run, with the dead zone for the gap that the twin knows."""
    condition = task.condition
    plant = known.replace(k=_times(known.k, condition.k), c=_times(known.c, condition.c), p=condition.pitch * known.p)
    law = known.controller
    run = simulate(
        plant,
        STEP * (CHUNK + 1) + SECONDS,
        controller=law if condition.noise is None else law.replace(sample_rate=RATE, loop_filter_hz=20.0),
        reference=SquareWave(AMPLITUDE, 2.0 * STEP),
        gap=task.gap,
        tolerance=known.tolerance_for(KNOWN_GAP),
        noise=condition.noise,
        seed=task.seed,
        theta_d0=float(np.random.default_rng(task.seed).uniform(-0.5, 0.5)) * task.gap,
    )
    for number in range(CHUNK):
        yield Window.from_run(run, STEP * (number + 1), SECONDS)


def _times(values: float | tuple[float, ...], factor: float) -> float | tuple[float, ...]:
    return tuple(factor * value for value in values) if isinstance(values, tuple) else factor * values
