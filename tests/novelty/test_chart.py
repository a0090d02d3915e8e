"""The chart: sums with exact average run lengths, a baseline that learns itself, a spread that steps do not move."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from servotwin.errors import InvalidInput
from servotwin.novelty.chart import Chart, add_window, normal, restarted, summed, with_fewer_windows
from servotwin.novelty.settings import NoveltyRules

STD = math.radians(0.01)
RULES = NoveltyRules(resolution=STD)


def exact_run_length(allowance: float, limit: float, mean: float = 0.0, states: int = 600) -> float:
    """Average run length of Page's one-sided sum by a Markov chain (Brook and Evans, 1972)."""
    width = 2.0 * limit / (2 * states - 1)
    centres = np.arange(states) * width
    high = centres[None, :] + 0.5 * width - centres[:, None] + allowance - mean
    low = high - width
    low[:, 0] = -np.inf
    moves = norm.cdf(high) - norm.cdf(low)
    return float(np.linalg.solve(np.eye(states) - moves, np.ones(states))[0])


def run_lengths(allowance: float, limit: float, runs: int, seed: int) -> float:
    """Mean of simulated run lengths of the two-sided sum."""
    rng, total = np.random.default_rng(seed), 0
    for _ in range(runs):
        up = down = 0.0
        while max(up, down) <= limit:
            up, down = summed(up, down, float(rng.standard_normal()), allowance)
            total += 1
    return total / runs


def after(gaps: np.ndarray, rules: NoveltyRules = RULES, std: float = STD, chart: Chart | None = None) -> list[int]:
    """Which windows were news."""
    chart, news = chart or Chart(), []
    for number, gap in enumerate(gaps.tolist()):
        seen = add_window(chart, gap, std, rules)
        chart = seen.chart
        if seen.sudden or seen.slow:
            news.append(number)
    return news


@pytest.mark.parametrize(("allowance", "limit"), [(0.5, 3.0), (0.5, 4.0), (0.25, 5.0)])
def test_run_lengths_are_those_of_the_markov_chain(allowance: float, limit: float) -> None:
    two_sided = 0.5 * exact_run_length(allowance, limit)
    assert run_lengths(allowance, limit, 1500, 1) == pytest.approx(two_sided, rel=0.08)


def test_the_limits_of_the_default_allow_a_thousand_windows() -> None:
    rules = NoveltyRules()
    slow = 2.0 / exact_run_length(rules.allowance, rules.cusum_limit)
    sudden = 2.0 * norm.sf(rules.score_limit)
    assert 1.0 / (slow + sudden) > 8000.0


@pytest.mark.slow
def test_false_alarms_are_rare_with_a_baseline_that_is_learnt() -> None:
    gaps = np.random.default_rng(7).normal(0.2, STD, 60_000)
    tight = NoveltyRules(resolution=0.02 * STD)
    assert len(after(gaps, tight)) <= 40  # 1500 windows each


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 3.0, 10.0])
def test_a_scatter_that_windows_do_not_know_of_is_learnt(factor: float) -> None:
    gaps = np.random.default_rng(8).normal(0.2, factor * STD, 30_000)
    news = after(gaps, replace(RULES, resolution=0.02 * STD))
    assert len([number for number in news if number > 30]) <= 30


@pytest.mark.parametrize("steps", [7.0, 10.0, -10.0, 100.0])
def test_a_step_is_seen_at_once_and_once(steps: float) -> None:
    gaps = np.random.default_rng(9).normal(0.2, STD, 80)
    gaps[50:] += steps * 1.5 * STD
    news = after(gaps)
    assert news[:1] == [50]
    assert len(news) <= 2


def test_slow_wear_is_seen_and_does_not_pass_for_scatter() -> None:
    gaps = 0.2 + np.random.default_rng(10).normal(0.0, STD, 400)
    gaps[100:] += 0.2 * STD * np.arange(300)
    news = after(gaps)
    assert 100 < news[0] < 130
    assert len(news) > 5
    steady = after(0.2 + 3.0 * STD * np.arange(200.0))
    assert len(steady) > 40


def test_recursive_residuals_are_independent_and_of_one_variance() -> None:
    rng, rules, changes = np.random.default_rng(11), NoveltyRules(1e-9, score_limit=1e3, cusum_limit=1e6), []
    for _ in range(400):
        chart, found = Chart(bends=(0.6744897501960817,) * 40), []
        for gap in rng.normal(1.0, STD, 12).tolist():
            seen = add_window(chart, gap, STD, rules)
            chart = restarted(seen.chart, seen.chart.gap, seen.chart.weight)
            chart = Chart(chart.gap, chart.weight, bends=(0.6744897501960817,) * 40)
            found.append(seen.change)
        changes.append(found[1:])
    values = np.array(changes)
    assert np.abs(values.std(axis=0) - 1.0).max() < 0.15
    assert np.abs(np.corrcoef(values.T) - np.eye(11)).max() < 0.2


def test_nothing_below_the_worth_is_news_and_its_sum_is() -> None:
    rules = replace(RULES, worth=math.radians(0.5))
    gaps = np.repeat(np.radians([1.0, 1.2, 1.4, 1.6, 1.8]), 10)
    assert after(gaps, rules) == [30]
    assert len(after(gaps)) >= 4


def test_an_update_leaves_a_few_windows_of_the_baseline() -> None:
    chart = Chart()
    for gap in np.random.default_rng(12).normal(0.2, STD, 100).tolist():
        chart = add_window(chart, gap, STD, RULES).chart
    again = with_fewer_windows(chart, 5)
    assert again.gap == chart.gap
    assert again.weight * chart.last[-1].variance == pytest.approx(5.0)
    assert (again.up, again.down, again.bends) == (0.0, 0.0, chart.bends)
    assert add_window(again, chart.gap + 12.0 * STD, STD, RULES).sudden


@pytest.mark.parametrize("freedom", [10.0, 18.0, 50.0])
def test_student_becomes_normal(freedom: float) -> None:
    for student in (-5.0, -2.0, -0.5, 0.0, 1.0, 3.0, 6.0):
        exact = norm.isf(t.sf(abs(student), freedom))
        assert normal(student, freedom) == pytest.approx(math.copysign(exact, student), abs=0.03)


@pytest.mark.parametrize(
    "changes", [{"resolution": 0.0}, {"score_limit": -1.0}, {"allowance": math.inf}, {"learn": -1}]
)
def test_rules_that_make_no_sense_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match=f"novelty {next(iter(changes))}"):
        NoveltyRules(**changes)  # type: ignore[arg-type]
