"""Candidate models: the chosen one, and what is said of the others."""

import numpy as np
import pytest

from servotwin.estimation.kinematic.models import Model, ModelScore, chosen, trials, undecided


def scored(name, squares):
    squares = np.array(squares)
    return ModelScore(Model(name, ("ratio", "offset")), 0.1, squares, float(np.sqrt(squares.mean())))


@pytest.fixture
def scores():
    return (
        scored("rigid", [4.0, 4.2, 3.8, 4.1]),
        scored("lag", [1.0, 1.1, 0.9, 1.0]),
        scored("richer", [0.99, 1.11, 0.9, 0.99]),
        scored("no gap, lag", [9.0, 9.5, 8.5, 9.0]),
    )


def test_a_richer_model_is_taken_on_evidence_only(scores):
    assert chosen(scores[:-1]).model.name == "lag"


def test_each_model_is_told_with_what_speaks_for_it(scores):
    simplest, taken, left, without = (each.evidence for each in trials(scores))
    assert simplest == "the simplest"
    assert taken.startswith("taken: 24.8 % of the square error of rigid (")
    assert left.startswith("not taken: 99.8 % of the square error of lag")
    assert without.startswith("a gap is needed; with one 11.1 % of the square error of no gap, lag (")


def test_where_no_gap_predicts_as_well_that_is_said(scores):
    assert trials((*scores[:-1], scored("no gap, lag", [0.5, 0.6, 0.5, 0.6])))[-1].evidence.startswith("no gap is need")
    assert trials(()) == ()


def test_a_richer_model_that_predicts_better_but_not_for_sure_is_undecided():
    rigid = scored("rigid", [4.0, 1.0, 3.8, 4.1])
    better, worse = (
        ModelScore(Model(name, (*rigid.model.used, name)), 0.1, np.array(squares), 1.0)
        for name, squares in (("lag", [1.0, 4.0, 3.0, 1.0]), ("cycle", [4.0, 1.0, 3.8, 4.1]))
    )
    assert undecided(rigid, (rigid, better, worse)) == (better,)
    assert undecided(better, (rigid, better, worse)) == ()
