"""Glances at machines that differ from their model: on the machine as learnt, and what is open of it is no news."""

from __future__ import annotations

import gc
import math
import tracemalloc
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from twin_messages import message_of

from benchmarks.estimator_windows import cut
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.estimation.whitened.quick import quick_fit
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.estimating import decode_window
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.evidence_rows import plain
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TriageSettings, TwinSettings
from servotwin.twin.triage import Glance, TriageState, glance
from servotwin.twin.twin import Twin

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
SETTINGS = TriageSettings()
OFF_BY = ((1.05, 1.3, 1.01, 1.0), (0.95, 0.7, 0.99, 1.0), (1.05, 0.7, 0.99, 1.02))
"""Factors on stiffness, damping, pitch and mass ratio."""


@cache
def off_windows(factors: tuple[float, ...], gap_deg: float, calm: bool, begin: float) -> tuple:
    """Messages of six steps of a machine that is off, with a floor of 1 um, from a sample time (s) on."""
    plant, gap = adapted(SERVO, np.log(factors)), gap_deg * DEG
    law = SERVO.controller.replace(Ki=0.0) if calm else SERVO.controller
    tolerance = None if calm else SERVO.tolerance_for(gap)
    run = simulate(plant, 34.0, controller=law, reference=SquareWave(1e-3, 10.0), gap=gap, tolerance=tolerance)
    rng, made = np.random.default_rng(round(begin)), []
    for k in range(6):
        case = cut(run, 5.0 * (k + 1) - (0.3 if calm else 0.0), 2.0 if calm else 1.0)
        window = case.noisy(1e-6 * rng.standard_normal(case.window.position.size)).window
        made.append(message_of(window, round(begin) + k, start=window.start + begin))
    return tuple(made)


def off_twin(factors: tuple[float, ...], calm: bool, learn: bool) -> EvidenceLog:
    """Evidence of a twin that saw six windows at 10 deg, and six at 10.5 deg."""
    settings = TwinSettings(triage=SETTINGS, policy="paper", learning=LearningSettings(learn=learn))
    twin = Twin("axis", TwinModel.of(SERVO, settings))
    for message in (*off_windows(factors, 10.0, calm, 0.0), *off_windows(factors, 10.5, calm, 100.0)):
        twin.receive(message, message.start + 3.0)
    return twin.log


@pytest.mark.slow
@pytest.mark.parametrize("calm", [False, True])
@pytest.mark.parametrize("factors", OFF_BY)
def test_a_learnt_machine_is_news_only_where_its_gap_moves(factors: tuple[float, ...], calm: bool) -> None:
    log = off_twin(factors, calm, learn=True)
    estimated = sorted(identity[2] for identity in log.estimates)
    assert estimated[0] == 0
    assert len([one for one in estimated if one < 100]) <= 2
    assert 100 in estimated
    assert len(estimated) <= 5
    assert "the gap moved" in log.glances["axis", "b", 100].why
    final = log.estimates["axis", "b", estimated[-1]]
    assert abs(final.gap - 10.5 * DEG) < 0.05 * DEG


@pytest.mark.parametrize("calm", [False, True])
def test_without_learning_such_a_machine_shows_nothing(calm: bool) -> None:
    log = off_twin(OFF_BY[0], calm, learn=False)
    assert not any(estimate.ok for estimate in log.estimates.values())
    assert all(one.machine is None for one in log.glances.values())


def test_a_machine_of_which_too_much_is_open_hides_no_move() -> None:
    window = decode_window(off_windows(OFF_BY[0], 10.0, False, 0.0)[2])
    usual = TriageState(doubt="", boot="b", gap=9.5 * DEG, std=0.005 * DEG, misfit=1e-6)
    message, whys = message_of(window, start=0.0), []
    for spread in (1e-5, 1.0):
        machine = FactorPrior(np.log(OFF_BY[0]), np.diag(np.square(spread * np.array([0.1, 0.5, 0.01, 0.01]))))
        whys.append(glance(message, window, SERVO, usual, settings=SETTINGS, machine=machine).why)
    assert all("the gap moved" in why for why in whys)
    wider = replace(SETTINGS, widest=1.0)
    assert not glance(message, window, SERVO, usual, settings=wider, machine=machine).moved


def test_what_a_glance_stood_on_is_part_of_its_evidence() -> None:
    log = off_twin(OFF_BY[0], calm=False, learn=True)
    first, second = (log.glances["axis", "b", k] for k in (0, 1))
    assert first.machine is None
    assert b"machine" not in plain(first)
    assert second.machine is not None
    assert math.exp(second.machine.factors[0]) == pytest.approx(1.05, abs=0.002)
    assert plain(msgspec.msgpack.decode(plain(second), type=Glance)) == plain(second)
    assert second.machine.factors == log.machines["axis", "b", 0].factors


def test_the_machines_spread_is_that_of_fits_to_other_machines() -> None:
    mean, covariance = np.log(OFF_BY[0]), np.diag(np.square([4e-4, 3e-3, 1e-4, 2e-4]))
    window = decode_window(off_windows(OFF_BY[0], 10.0, False, 0.0)[2])
    here = quick_fit(window, SERVO, 10.0 * DEG, None, FactorPrior(mean, covariance))
    alone = quick_fit(window, adapted(SERVO, mean), 10.0 * DEG)
    assert here.gap == pytest.approx(alone.gap, abs=1e-3 * DEG)
    assert here.std == pytest.approx(alone.std, rel=0.1)
    assert alone.machine_spread() == (0.0, 0.0)
    moved = []
    for axis in np.linalg.cholesky(covariance).T:
        ends = [quick_fit(window, adapted(SERVO, mean + sign * axis), 10.0 * DEG).gap for sign in (1.0, -1.0)]
        moved.append(0.5 * (ends[0] - ends[1]))
    assert here.machine_spread().gap == pytest.approx(float(np.linalg.norm(moved)), rel=0.05)


@pytest.mark.slow
def test_glances_keep_little_of_the_machines_that_they_have_seen() -> None:
    """A worker of a fleet meets thousands of machines, each of which comes back after all the others."""
    window = decode_window(off_windows(OFF_BY[0], 10.0, False, 0.0)[0])
    rng, covariance = np.random.default_rng(3), np.diag([1e-6, 1e-5, 1e-7, 1e-6])
    machines = [FactorPrior(1e-3 * rng.standard_normal(4), covariance) for _ in range(300)]
    used = []
    tracemalloc.start()
    for some in (machines[:100], machines[100:]):  # after the first ones other caches are full
        for machine in some:
            quick_fit(window, SERVO, 10.0 * DEG, None, machine)
        gc.collect()
        used.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    kept = (used[1] - used[0]) / 200
    assert kept < 4000.0  # one row of a window is as much


def test_a_glance_at_a_machine_that_was_seen_before_computes_no_response(monkeypatch) -> None:
    window = decode_window(off_windows(OFF_BY[0], 10.0, False, 0.0)[0])
    machine = FactorPrior(np.array([1e-3, 2e-3, 3e-4, 4e-3]), np.diag([1e-6, 1e-5, 1e-7, 1e-6]))
    first = quick_fit(window, SERVO, 10.0 * DEG, None, machine)
    monkeypatch.setattr("servotwin.estimation.whitened.quick.variants", None)
    assert quick_fit(window, SERVO, 10.0 * DEG, None, replace(machine)) == first
