"""Ranking of candidates as far as it is asked for: the order of a full ranking, with fewer simulations."""

from __future__ import annotations

import math
from itertools import islice

import numpy as np
import pytest

from servotwin.plant.servo import Servo
from servotwin.redesign.certified import screening as module
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.attempt import ROUNDED, Question
from servotwin.redesign.certified.certificate import Demands
from servotwin.redesign.certified.certify import candidates_of
from servotwin.redesign.certified.screening import Screening, is_plain
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import SimulatedMachines, Uncertainty, draw
from servotwin.redesign.design import Design

SERVO, DEMANDS = Servo.preset("paper"), Demands()
UNCERTAINTY = Uncertainty(gap=(0.1, math.radians(40.0)), input_bias=(-0.02, 0.03))


def question_and_candidates() -> tuple[Question, list[Design]]:
    trial = trial_for(SERVO, UNCERTAINTY, DEMANDS)
    candidates = candidates_of(SERVO, UNCERTAINTY, DEMANDS, disturbed=True, noisy=False)
    return Question(SERVO, UNCERTAINTY, DEMANDS, trial, noise=0.0), candidates


def fully_ranked(question: Question, candidates: list[Design]) -> list[Design]:
    """Every candidate on every machine."""
    demands = question.demands
    members = draw(SERVO, UNCERTAINTY, demands.screened, demands.conditions, demands.seed)
    measures = assess(candidates, members, question.trial.half)

    def rank(k: int) -> tuple[bool, float]:
        few = measures[k]
        fails = float(np.mean(few.settled)) < demands.settled or few.overshoot.max() > demands.overshoot
        fails = fails or bool(few.tail.max() > ROUNDED * question.largest_error(candidates[k]))
        return fails, float(np.percentile(few.cost, 95.0))

    return [candidates[k] for k in sorted(range(len(candidates)), key=rank)]


def test_the_order_is_that_of_all_candidates_on_all_machines() -> None:
    question, every = question_and_candidates()
    candidates = every[::7]
    ranked = list(Screening(question).ranked(candidates))
    assert len(candidates) > 5
    assert ranked == fully_ranked(question, candidates)


def test_the_first_candidates_cost_fewer_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    question, candidates = question_and_candidates()
    runs = 0

    def counted(settings: list[Design], members: SimulatedMachines, *rest: object) -> object:
        nonlocal runs
        runs += len(settings) * members.count
        return assess(settings, members, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "assess", counted)
    first = list(islice(Screening(question).ranked(candidates), 2))
    assert first == fully_ranked(question, candidates)[:2]
    assert runs < 0.5 * len(candidates) * DEMANDS.screened * DEMANDS.conditions


def test_only_those_that_meet_the_demands_come_first() -> None:
    """On a machine with an unknown bias some candidates leave too much of an error."""
    question, every = question_and_candidates()
    candidates = every[::7]
    screening = Screening(question)
    expected = [each for each in fully_ranked(question, candidates) if not screening.fails(each)]
    assert list(Screening(question).ranked(candidates, passing=True)) == expected


def test_candidates_that_are_not_plain_can_be_dropped_on_the_way() -> None:
    question, every = question_and_candidates()
    candidates = every[::7]
    expected, screening = fully_ranked(question, candidates), Screening(question)
    ranked = screening.ranked(candidates)
    first = [next(ranked)]
    screening.plain_only = True
    assert [*first, *ranked] == [*expected[:1], *(each for each in expected[1:] if is_plain(each))]
    assert 0 < sum(is_plain(each) for each in expected[1:]) < len(expected) - 1
