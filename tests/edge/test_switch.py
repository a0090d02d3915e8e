"""When an update is applied: safe instants, patience, one waiting at a time, the fallback set."""

from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from servotwin.control import Controller
from servotwin.control.gains import gains_of, with_gains
from servotwin.edge.guard import Instant, Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.supervisor import PendingUpdate, Rules, Switch, apply_pending, fall_back, is_safe, offer
from servotwin.edge.watch import Violation
from servotwin.messages import Band, Cause, Fallback, Gains, Reason, Receipt, Setting, Update

PAPER = Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, sample_rate=5000.0)
OWN = gains_of(PAPER)
CALM = replace(OWN, Ki=0.0, feedforward=0.05)
BAND = Band(5e-5, 2e-5, 0.1, 2.0)
RULES = Rules(Limits(patience_s=2.0), PAPER)
UPDATE = Update("axis-1", 1, 0, ("b0", 0), 20.0, 0.1, 0.01, (0.08, None), "OK", Setting(2e-4, CALM, BAND), 60.0)
START = Switch(Parameters(setting=Setting(1e-4, OWN)))


def at(seconds: float) -> Instant:
    return Instant("axis-1", "b0", round(seconds * 5000), 5000.0)


def reasons(replies: tuple[Any, ...]) -> list[tuple[int, Reason]]:
    return [(receipt.version, receipt.reason) for receipt in replies]


@pytest.mark.parametrize("error", [0.0, 0.99e-4, -0.99e-4, 2.01e-4, -3e-4, None])
def test_a_safe_instant_is_used_at_once(error: float | None) -> None:
    state, replies = offer(START, UPDATE, RULES, at(22.0), error)
    assert reasons(replies) == [(1, Reason.APPLIED)]
    assert state == Switch(Parameters(1, Setting(2e-4, CALM, BAND), 20.0, ("b0", 0), 110_000, gap=0.1))
    assert isinstance(replies[0], Receipt)
    assert replies[0].sample == 110_000


@pytest.mark.parametrize("error", [1e-4, 1.5e-4, -2e-4])
def test_an_update_waits_between_the_thresholds_and_its_receipt_names_the_sample(error: float) -> None:
    state, replies = offer(START, UPDATE, RULES, at(22.0), error)
    assert (replies, state.current) == ((), START.current)
    assert apply_pending(state, RULES, at(22.5), error) == (state, ())
    state, replies = apply_pending(state, RULES, at(22.6), 2.1e-4)
    assert isinstance(replies[0], Receipt)
    assert (replies[0].applied, replies[0].sample) == (True, 113_000)
    assert state.current.sample == 113_000
    assert state.pending is None


def test_patience_ends_and_the_update_is_applied() -> None:
    state, _ = offer(START, UPDATE, RULES, at(22.0), 1.5e-4)
    assert apply_pending(state, RULES, at(23.9998), 1.5e-4).state.current is START.current
    assert reasons(apply_pending(state, RULES, at(24.0), 1.5e-4).messages) == [(1, Reason.APPLIED)]


def test_without_patience_nothing_waits() -> None:
    assert reasons(offer(START, UPDATE, Rules(Limits(), PAPER), at(22.0), 1.5e-4).messages) == [(1, Reason.APPLIED)]


def test_an_update_that_expires_while_it_waits_is_refused() -> None:
    state, _ = offer(START, replace(UPDATE, not_after=23.0), RULES, at(22.0), 1.5e-4)
    state, replies = apply_pending(state, RULES, at(23.0), 0.0)
    assert reasons(replies) == [(1, Reason.EXPIRED)]
    assert state == START


def test_a_copy_of_the_pending_update_gets_no_answer_yet() -> None:
    state, _ = offer(START, UPDATE, RULES, at(22.0), 1.5e-4)
    assert offer(state, UPDATE, RULES, at(22.5), 0.0) == (state, ())


def test_a_newer_update_replaces_the_pending_one() -> None:
    state, _ = offer(START, UPDATE, RULES, at(22.0), 1.5e-4)
    newer = replace(UPDATE, version=2, window=("b0", 1), data_time=21.0)
    state, replies = offer(state, newer, RULES, at(22.5), 1.5e-4)
    assert reasons(replies) == [(1, Reason.SUPERSEDED)]
    assert state.pending == PendingUpdate(newer, at(22.5).sample)
    older = replace(newer, version=3, data_time=20.5)
    assert reasons(offer(state, older, RULES, at(22.6), 0.0).messages) == [(3, Reason.OLD_DATA)]
    assert reasons(offer(state, UPDATE, RULES, at(22.6), 0.0).messages) == [(1, Reason.OLD_VERSION)]


@pytest.mark.parametrize(
    ("old", "new", "error", "safe"),
    [
        (0.0, 1e-4, 0.0, False),  # a closed loop at rest would be opened
        (0.0, 1e-4, 1.6e-4, True),
        (1e-4, 0.0, 0.2e-4, False),  # an open loop would be closed
        (1e-4, 0.0, 1.6e-4, True),
        (1e-4, 2e-4, 0.4e-4, True),
        (1e-4, 2e-4, 0.6e-4, False),
        (1e-4, 2e-4, 2.9e-4, False),
        (1e-4, 2e-4, 3.1e-4, True),
        (1e-4, 1e-4, 0.9e-4, True),
    ],
)
def test_every_threshold_counts(old: float, new: float, error: float, safe: bool) -> None:
    controller = PAPER.replace(enter=0.5, leave=1.5)
    assert is_safe(Parameters(setting=Setting(old)), Parameters(setting=Setting(new)), controller, error) is safe


def test_without_a_controller_gains_are_refused() -> None:
    rules = Rules(Limits())
    assert reasons(offer(START, UPDATE, rules, at(22.0), 0.0).messages) == [(1, Reason.NO_GAINS)]
    assert reasons(offer(START, replace(UPDATE, setting=Setting(2e-4, None, BAND)), rules, at(22.0), 0.0).messages) == [
        (1, Reason.APPLIED)
    ]


def test_an_update_without_gains_leaves_them() -> None:
    state, _ = offer(START, UPDATE, RULES, at(22.0), 0.0)
    second = replace(UPDATE, version=2, base_version=1, window=("b0", 1), data_time=21.0, setting=Setting(2e-4))
    state, _ = offer(state, second, RULES, at(23.0), 0.0)
    assert (state.current.setting.gains, state.current.setting.band) == (CALM, None)


VERDICT = Violation(Cause.LIMIT_CYCLE, 2e-4, 5e-5)
SET = FallbackSet(Setting(0.0, CALM, BAND), refuse_s=10.0)


def test_the_fallback_set_is_a_version_of_its_own() -> None:
    state = Switch(Parameters(4, Setting(1e-4, OWN), 20.0, ("b0", 0), 100_000))
    waiting = replace(UPDATE, version=6, base_version=4, data_time=21.0)
    state, _ = offer(state, waiting, RULES, at(22.0), 1.5e-4)
    state, replies = fall_back(state, SET, VERDICT, at(23.0))
    assert reasons(replies[:1]) == [(6, Reason.FELL_BACK)]
    assert replies[1] == Fallback("axis-1", "b0", 115_000, Cause.LIMIT_CYCLE, 2e-4, 5e-5, 4, 7, Setting(0.0, CALM))
    assert (state.current.version, state.current.setting.gains, state.current.setting.band) == (7, CALM, BAND)
    assert state.current.fallback


@pytest.mark.parametrize(
    ("changes", "seconds", "reason"),
    [
        ({"version": 4, "base_version": 3}, 40.0, Reason.FELL_BACK),
        ({"version": 5, "base_version": 4}, 40.0, Reason.FELL_BACK),  # the twin's next, when it has not heard of it
        ({"version": 6, "base_version": 5}, 40.0, Reason.FELL_BACK),  # and the one after that
        ({"version": 9, "base_version": 4, "data_time": 24.0}, 40.0, Reason.FELL_BACK),
        ({"version": 9, "base_version": 5, "data_time": 23.0}, 40.0, Reason.FELL_BACK),
        ({"version": 9, "base_version": 6, "data_time": 24.0}, 40.0, Reason.BASE_MISMATCH),
        ({"version": 5, "base_version": 5, "data_time": 24.0}, 40.0, Reason.OLD_VERSION),
        ({"version": 9, "base_version": 5, "data_time": 24.0}, 32.9, Reason.AFTER_FALLBACK),
        ({"version": 9, "base_version": 5, "data_time": 24.0}, 33.0, Reason.APPLIED),
    ],
)
def test_after_a_fallback_updates_need_newer_data_and_wait(
    changes: dict[str, Any], seconds: float, reason: Reason
) -> None:
    state, _ = fall_back(Switch(Parameters(4, Setting(1e-4), 20.0)), SET, VERDICT, at(23.0))
    (receipt,) = offer(state, replace(UPDATE, **changes), RULES, at(seconds), 1e-3).messages
    assert isinstance(receipt, Receipt)
    in_force = 5 if reason is not Reason.APPLIED else changes["version"]
    assert (receipt.reason, receipt.version, receipt.parameter_version) == (reason, changes["version"], in_force)


def test_each_further_fallback_refuses_twice_as_long() -> None:
    state, waits = START, []
    for k in range(9):
        here = at(100.0 * (k + 1))
        state = fall_back(state, SET, VERDICT, here).state
        waits.append((state.current.not_before - here.sample) / here.rate)
    assert waits == [10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 640.0, 640.0]


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 9), st.floats(0.0, 4e-4)), max_size=40))
def test_every_update_is_answered_at_most_once_and_versions_only_rise(steps: list[tuple[int, int, float]]) -> None:
    state, answered, number, second = START, [], count(1), 0.0
    for kind, jump, error in steps:
        second += 0.1 * jump
        before = state.current
        if kind == 0:
            update = replace(UPDATE, version=next(number), base_version=before.version, data_time=second - 0.05)
            state, replies = offer(state, update, RULES, at(second), error)
        elif kind == 1:
            state, replies = fall_back(state, FallbackSet(Setting(0.0, CALM), refuse_s=0.0), VERDICT, at(second))
            number = count(state.current.version + 1)
        else:
            state, replies = apply_pending(state, RULES, at(second), error)
        answered += [receipt.version for receipt in replies if isinstance(receipt, Receipt)]
        assert state.current.version > before.version or state.current is before
        assert state.current.data_time >= before.data_time
    assert len(answered) == len(set(answered))


def test_gains_become_a_controller_and_back() -> None:
    assert gains_of(with_gains(PAPER, CALM)) == CALM
    assert with_gains(PAPER, None) is PAPER
    assert with_gains(PAPER.replace(voltage_limit=24.0), CALM).voltage_limit == 24.0


def test_gains_of_integers_are_floats() -> None:
    assert gains_of(Controller(Kp=1, Ki=0, Kd=0, Tf=1)) == Gains(1.0, 0.0, 0.0, 1.0)
