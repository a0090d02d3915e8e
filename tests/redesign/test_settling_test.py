"""The test of the share that settles, in two stages, against sums over binomial distributions and drawn samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta, binom, binomtest

from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.redesign.certified import attempt as module
from servotwin.redesign.certified.assess import MachineMeasures
from servotwin.redesign.certified.attempt import Attempt, Question
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.settling_test import SettlingTest, share_at_least
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

TESTS = [SettlingTest(0.99, 0.95, 300), SettlingTest(0.95, 0.95, 60), SettlingTest(0.9, 0.9, 64)]


def passing(test: SettlingTest, share: float, most: int) -> float:
    """Probability of a pass of the first stage, or of at most so many failures in both."""
    first, more = np.arange(test.allowed + 1), test.whole - test.first
    ways = binom.pmf(first, test.first, 1.0 - share) * binom.cdf(most - first, more, 1.0 - share)
    return float(binom.cdf(test.allowed_first, test.first, 1.0 - share) + ways[test.allowed_first + 1 :].sum())


@pytest.mark.parametrize("test", TESTS)
def test_a_share_that_is_too_small_passes_as_rarely_as_is_demanded(test: SettlingTest) -> None:
    assert passing(test, test.share, test.allowed) <= 1.0 - test.confidence
    smaller = SettlingTest(test.share, test.confidence, test.first)
    smaller.__dict__["whole"] = test.whole - 1
    assert passing(smaller, test.share, test.allowed) > 1.0 - test.confidence


@pytest.mark.parametrize("test", TESTS)
def test_samples_that_are_drawn_pass_as_often_as_is_computed(test: SettlingTest) -> None:
    rng = np.random.default_rng(3)
    for share in (test.share, 1.0 - 0.3 * (1.0 - test.share)):
        first = rng.binomial(test.first, 1.0 - share, 40_000)
        both = first + rng.binomial(test.whole - test.first, 1.0 - share, first.size)
        open_ = np.array([test.is_open(int(count)) for count in first])
        passed = np.where(open_, both <= test.allowed, first <= test.allowed_first)
        assert passed.mean() == pytest.approx(passing(test, share, test.allowed), abs=0.01)


def test_a_setting_that_settles_on_998_of_1000_machines_is_refused_far_more_rarely_than_by_one_sample() -> None:
    test = TESTS[0]
    once = float(binom.cdf(0, 300, 0.002))
    assert (test.allowed_first, test.allowed, test.whole) == (0, 3, 1227)
    assert 1.0 - passing(test, 0.998, 3) < 0.4 * (1.0 - once)


@pytest.mark.parametrize("test", TESTS)
def test_the_bound_of_the_second_stage_is_the_share_of_which_so_good_a_result_is_rare(test: SettlingTest) -> None:
    for failures in range(test.allowed_first + 1, test.allowed + 1):
        least = test.at_least(failures, test.whole)
        assert passing(test, least, failures) == pytest.approx(1.0 - test.confidence, rel=1e-6)
        assert least >= test.share


def test_other_results_have_the_bound_of_one_sample() -> None:
    test = TESTS[0]
    assert test.at_least(0, 300) == pytest.approx(0.05 ** (1.0 / 300.0))
    assert test.at_least(5, 300) == pytest.approx(beta.ppf(0.05, 295, 6))
    assert test.at_least(4, 700) == pytest.approx(beta.ppf(0.05, 696, 5))


def test_a_sample_that_is_too_small_for_any_pass_has_no_second_stage() -> None:
    test = SettlingTest(0.99, 0.95, 16)
    assert (test.allowed_first, test.whole, test.is_open(0), test.is_refused(1)) == (-1, 16, False, True)


# --- bounds of a share


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (7, 10), (299, 300), (300, 300)])
def test_the_share_is_at_least_the_bound_of_clopper_and_pearson(successes: int, trials: int) -> None:
    exact = binomtest(successes, trials, alternative="greater").proportion_ci(0.95, "exact").low
    assert share_at_least(successes, trials, 0.95) == pytest.approx(exact, abs=1e-12)


def test_three_hundred_machines_without_a_failure_show_ninety_nine_percent() -> None:
    assert share_at_least(300, 300, 0.95) == pytest.approx(0.05 ** (1.0 / 300.0))
    assert share_at_least(299, 300, 0.95) < 0.99 < share_at_least(300, 300, 0.95)
    with pytest.raises(InvalidInput, match="4 successes in 3 trials"):
        share_at_least(4, 3, 0.95)


# --- of a setting

SERVO = Servo.preset("paper")
KNOWN = Uncertainty(gap=(0.17, 0.18), input_bias=(-1e-4, 1e-4))
FEW = Demands(Ms=20.0, Ms_worst=20.0, machines=16, settled=0.8, beyond=Beyond(machines=0))
CALM = Design(SERVO.controller.replace(Kp=0.7 * SERVO.controller.Kp, Kd=0.7 * SERVO.controller.Kd, Ki=0.0), 0.0)


def tried(monkeypatch: pytest.MonkeyPatch, swinging: list[int]) -> Attempt:
    """A setting that settles everywhere, but that so many machines of each sample are made to swing."""
    real, left = module.assess, list(swinging)

    def spoiled(settings: list[Design], *rest: object) -> list[MachineMeasures]:
        (found,) = real(settings, *rest)  # type: ignore[arg-type]
        ripple = found.ripple.copy()
        ripple[: left.pop(0) if left else 0] = np.inf
        return [replace(found, ripple=ripple)]

    monkeypatch.setattr(module, "assess", spoiled)
    return Attempt(Question(SERVO, KNOWN, FEW, trial_for(SERVO, KNOWN, FEW), 0.0), CALM)


@pytest.mark.parametrize(("swinging", "machines"), [([0], 16), ([1], 40), ([3], 40), ([1, 0, 2], 40), ([4], 16)])
def test_a_first_sample_with_few_failures_is_followed_by_a_larger_one(
    monkeypatch: pytest.MonkeyPatch, swinging: list[int], machines: int
) -> None:
    attempt = tried(monkeypatch, swinging)
    found = attempt.decided()
    assert found.members == machines
    assert found.settled == pytest.approx(1.0 - sum(swinging) / machines)
    assert (attempt.verified() is not None) is (sum(swinging) <= 3)
    assert attempt.question.shortcoming(found) == "" or "settles on 75.0 % of 16" in attempt.question.shortcoming(found)


def test_the_second_sample_ends_as_soon_as_too_many_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 24 further machines in two lots the first is enough."""
    attempt = tried(monkeypatch, [1, 3])
    found = attempt.decided()
    assert (found.members, attempt.verified()) == (32, None)
    assert found.settled_least == pytest.approx(beta.ppf(0.05, 28, 5))


def test_where_no_machine_may_fail_there_is_no_second_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    attempt = tried(monkeypatch, [1])
    strict = Attempt(replace(attempt.question, demands=replace(FEW, failures=0)), CALM)
    assert strict.question.settling.whole == 16
    assert (strict.decided().members, strict.verified()) == (16, None)
