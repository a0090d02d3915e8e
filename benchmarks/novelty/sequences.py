"""Sequences of windows drawn from the pools: windows until the chart detects a change, or gives a false alarm."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmarks.novelty.windows import ScorePool
from servotwin.novelty.chart import Chart, add_window, restarted, with_fewer_windows
from servotwin.novelty.settings import NoveltyRules
from servotwin.plant.signals import Array

QUIET = 50  # windows before a change
LONGEST = 2000  # windows after it that are waited for


class Delays(NamedTuple):
    """Windows from a change to its detection; the first window after the change counts as 1.

    Attributes
    ----------
    median, late : float
        Median and 90 % point; inf: not seen.
    at_once : float
        Share detected in the first window.
    """

    median: float
    late: float
    at_once: float


def follow(chart: Chart, scores: Array, rules: NoveltyRules) -> Iterator[tuple[Chart, bool]]:
    """Yield the chart after each of some windows (n, 2), and True where the window was news."""
    for gap, std in scores.tolist():
        result = add_window(chart, gap, std, rules)
        chart = result.chart
        yield chart, result.sudden or result.slow


def run_length(pool: ScorePool, rules: NoveltyRules, windows: int, rng: np.random.Generator) -> tuple[float, int]:
    """Windows per false alarm where nothing changes, after the first few; and the number of alarms."""
    chart = _settled(pool, rules, rng)
    alarms = sum(news for _, news in follow(chart, pool.drawn(windows, rng), rules))
    return windows / max(1, alarms), alarms


def delays(
    before: ScorePool, after: ScorePool, rules: NoveltyRules, trials: int, rng: np.random.Generator, fresh: bool = False
) -> Delays:
    """Windows until a step of the gap is detected; `fresh`: the baseline has begun anew with the last window."""
    counts = [_delay(before, after, 0.0, rules, rng, fresh) for _ in range(trials)]
    return _summary(counts)


def wearing(pool: ScorePool, rate: float, rules: NoveltyRules, trials: int, rng: np.random.Generator) -> Delays:
    """Windows until a growth of `rate` (rad per window) is detected."""
    counts = [_delay(pool, pool, rate, rules, rng, fresh=False) for _ in range(trials)]
    return _summary(counts)


def _summary(counts: list[float]) -> Delays:
    middle, late = (float(np.quantile(counts, share, method="higher")) for share in (0.5, 0.9))
    return Delays(middle, late, float(np.mean(np.array(counts) == 1.0)))


def _delay(
    before: ScorePool, after: ScorePool, rate: float, rules: NoveltyRules, rng: np.random.Generator, fresh: bool
) -> float:
    chart = _settled(before, rules, rng)
    if fresh:
        chart = with_fewer_windows(restarted(chart, float(before.drawn(1, rng)[0, 0]), math.inf), 1)
    for start in range(0, LONGEST, QUIET):
        scores = after.drawn(QUIET, rng)
        scores[:, 0] += rate * np.arange(start + 1, start + QUIET + 1)
        for number, (later, news) in enumerate(follow(chart, scores, rules), start + 1):
            if news:
                return float(number)
            chart = later
    return math.inf


def _settled(pool: ScorePool, rules: NoveltyRules, rng: np.random.Generator) -> Chart:
    """Make a chart that has learnt some windows."""
    chart = Chart()
    for later, _ in follow(chart, pool.drawn(QUIET, rng), rules):
        chart = later
    return chart


def one_window(before: ScorePool, after: ScorePool, false_alarms: float) -> float:
    """Share of single windows beyond the limit that a share of the unchanged ones exceeds: the baseline is known."""
    resting, changed = (pool.scores[..., 0].ravel() for pool in (before, after))
    limit = np.quantile(np.abs(resting - resting.mean()), 1.0 - false_alarms)
    return float(np.mean(np.abs(changed - resting.mean()) > limit))
