"""What is asked for when windows tell too little: what, in which order, how large, and why not."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus, UnknownRatio
from servotwin.messages import Ask, LongerWindow, Probe, RequestOutcome
from servotwin.redesign.excitation import (
    Decision,
    ExcitationPolicy,
    ExcitationSettings,
    ExcitationState,
    Stage,
    WindowSummary,
    long_enough,
)

PITCH = 1e-3 / math.pi
DEG = math.pi / 180.0
ALLOWED = ExcitationSettings(probe=2e-4)
SHORT = WindowSummary(0.0, GapStatus.UNIDENTIFIABLE, long=False, upper=20.0 * DEG)
LONG = replace(SHORT, long=True)


def run(
    settings: ExcitationSettings, seen: list[WindowSummary], state: ExcitationState | None = None
) -> list[Decision]:
    policy, state, found = ExcitationPolicy(PITCH, settings), state or ExcitationState(), list[Decision]()
    for each in seen:
        found.append(policy.decide(state, each))
        state = found[-1].state
    return found


def asks(
    settings: ExcitationSettings, seen: list[WindowSummary], state: ExcitationState | None = None
) -> list[Ask | None]:
    return [decision.ask for decision in run(settings, seen, state)]


def test_a_longer_window_is_requested_first() -> None:
    assert asks(ALLOWED, [SHORT] * 4) == [None, LongerWindow(2.0, 0.3), None, None]


def test_a_lower_bound_counts_as_too_little_information() -> None:
    assert asks(ALLOWED, [replace(SHORT, status=GapStatus.LOWER_BOUND), SHORT])[-1] == LongerWindow(2.0, 0.3)


def test_a_probing_move_waits_for_the_window_that_may_confirm_what_two_contacts_show() -> None:
    first = replace(LONG, unconfirmed=True)
    waits, asked = run(ALLOWED, [LONG, first, LONG])[1:]
    assert waits.ask is None
    assert waits.reason.endswith("but two contacts show it: the next one may confirm it")
    assert isinstance(asked.ask, Probe)
    assert isinstance(asks(ALLOWED, [replace(SHORT, unconfirmed=True)] * 2)[1], LongerWindow)


@pytest.mark.parametrize("status", [GapStatus.OK, GapStatus.MODEL_MISMATCH])
def test_an_estimate_and_a_model_mismatch_reset_the_count(status: GapStatus) -> None:
    assert asks(ALLOWED, [SHORT, replace(SHORT, status=status), SHORT]) == [None] * 3
    assert asks(ALLOWED, [replace(SHORT, status=status)] * 9) == [None] * 9


def test_a_probe_comes_only_after_long_windows_have_failed_as_often() -> None:
    taken = run(ALLOWED, [SHORT, SHORT])[-1].state.answered(LongerWindow(2.0, 0.3), RequestOutcome.ACCEPTED)
    found = asks(ALLOWED, [SHORT, LONG, LONG], taken)
    assert found[:2] == [None, None]
    assert found[2] == Probe(PITCH * 25.0 * DEG, 0.85, 1)


def test_with_long_windows_a_probe_is_requested_at_once_after_enough_misses() -> None:
    assert [type(ask) for ask in asks(ALLOWED, [LONG, LONG])] == [type(None), Probe]


def test_where_long_windows_are_refused_the_probe_is_what_is_left() -> None:
    refused = run(ALLOWED, [SHORT, SHORT])[-1].state.answered(LongerWindow(2.0, 0.3), RequestOutcome.TOO_LARGE)
    assert isinstance(asks(ALLOWED, [SHORT, SHORT], refused)[-1], Probe)


def test_a_request_that_was_lost_is_made_again() -> None:
    lost = run(ALLOWED, [SHORT, SHORT])[-1].state.answered(LongerWindow(2.0, 0.3), None)
    assert asks(ALLOWED, [SHORT, SHORT], lost) == [None, LongerWindow(2.0, 0.3)]


def test_without_permission_there_is_no_probe_and_the_reason_says_so() -> None:
    found = run(ExcitationSettings(), [LONG] * 50)
    assert not any(decision.ask for decision in found)
    assert found[-1].reason.endswith("and a probing move is not allowed")


def test_a_limit_that_is_too_small_gives_a_reason_and_no_probe() -> None:
    found = run(ExcitationSettings(probe=1e-4), [LONG] * 2)[-1]
    assert found.ask is None
    assert found.reason.endswith("a probing move must be 0.139 mm, and at most 0.1 mm are allowed")


def test_probes_keep_their_distance() -> None:
    seen = [replace(LONG, time=10.0 * k) for k in range(20)]
    times = [each.time for each, ask in zip(seen, asks(ALLOWED, seen), strict=True) if ask]
    assert times == [10.0, 70.0, 130.0, 190.0]
    why = run(ALLOWED, seen)[4].reason
    assert why.endswith("the last probing move was requested 30 s ago, and 60 s must lie between two")


@pytest.mark.parametrize("change", [{"upper": math.inf}, {"slack": math.nan}])
def test_without_a_bounded_gap_and_dead_zone_there_is_no_probe(change: dict[str, float]) -> None:
    found = run(ALLOWED, [replace(LONG, **change)] * 2)[-1]
    assert found.ask is None
    assert "bounded" in found.reason


@pytest.mark.parametrize("outcome", [RequestOutcome.NOT_ALLOWED, RequestOutcome.TOO_LARGE])
def test_an_edge_that_refuses_gets_no_request_before_it_boots(outcome: RequestOutcome) -> None:
    late = replace(LONG, time=1e6)
    refused = run(ALLOWED, [LONG, LONG])[-1].state.answered(Probe(1e-4, 0.85), outcome)
    assert asks(ALLOWED, [late] * 5, refused) == [None] * 5
    assert run(ALLOWED, [late] * 5, refused)[-1].reason.endswith("this edge refuses probing moves")
    assert isinstance(asks(ALLOWED, [late] * 2, refused.rebooted())[-1], Probe)


def test_a_boot_forgets_the_windows_and_not_when_the_last_probe_was() -> None:
    state = ExcitationState(3, Stage.ACCEPTED, Stage.REFUSED, 12.0)
    assert state.rebooted() == ExcitationState(probed=12.0)


@given(
    upper=st.floats(0.0, 1.0),
    slack=st.floats(0.0, 1e-3),
    limit=st.floats(1e-6, 1e-2),
    margin=st.floats(0.5 * DEG, 0.5),
)
def test_a_probe_crosses_gap_and_dead_zone_and_keeps_to_the_limit(
    upper: float, slack: float, limit: float, margin: float
) -> None:
    settings = ExcitationSettings(probe=limit, margin=margin)
    decision = run(settings, [replace(LONG, upper=upper, slack=slack)] * 2)[-1]
    assert decision.reason
    if isinstance(decision.ask, Probe):
        assert limit >= decision.ask.size >= slack + PITCH * (upper + 0.5 * DEG) * (1.0 - 1e-12)
    else:
        assert slack + PITCH * (upper + margin) > limit


@given(st.lists(st.tuples(st.sampled_from(GapStatus), st.booleans(), st.floats(0.0, 30.0)), max_size=60))
def test_whatever_comes_probes_keep_distance_and_come_last(history: list[tuple[GapStatus, bool, float]]) -> None:
    """Every stretch of statuses: at least `after` misses before each ask, no probe within the interval."""
    time, seen = 0.0, list[WindowSummary]()
    for status, long, pause in history:
        time += pause
        seen.append(WindowSummary(time, status, long, 10.0 * DEG))
    found = run(ALLOWED, seen)
    assert all(decision.reason for decision in found)
    probed = [each.time for each, decision in zip(seen, found, strict=True) if isinstance(decision.ask, Probe)]
    assert all(after - before >= ALLOWED.times.interval for before, after in pairwise(probed))
    for k, decision in enumerate(found):
        if decision.ask:
            assert k >= 1
            assert {s.status for s in seen[k - 1 : k + 1]} <= {GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND}
            assert seen[k].long == isinstance(decision.ask, Probe)


def test_a_window_is_long_enough_with_the_requested_length_and_pre_trigger() -> None:
    assert long_enough(2.0, 0.3, ALLOWED)
    assert long_enough(2.0 - 1e-9, 0.3, ALLOWED)
    assert not long_enough(1.0, 0.3, ALLOWED)
    assert not long_enough(2.0, 0.0, ALLOWED)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"after": 0}, "after = 0: must be an integer, at least 1"),
        ({"strokes": 0}, "strokes = 0"),
        ({"window": math.inf}, "window = inf s"),
        ({"pre_trigger": 2.0}, "pre_trigger = 2.0 s: must be below 2.0 s, "),
        ({"probe": -1e-4}, "probe = -0.0001 m"),
        ({"interval": 0.0}, "interval = 0.0 s"),
        ({"hold": math.nan}, "hold = nan s"),
        ({"margin": 0.0}, "margin = 0.0 rad"),
    ],
)
def test_bad_settings_are_named(changes: dict[str, float], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        ExcitationSettings(**changes)


RATIO = UnknownRatio(known=5e-3, needed=1e-3, widest=4.0 * DEG)
UNTOLD = replace(SHORT, ratio=RATIO, noise=1e-8)


def test_windows_that_do_not_tell_the_ratio_lead_to_moves_of_two_lengths_at_once() -> None:
    """Each crosses the widest gap that the window leaves possible; no longer window is asked for first."""
    none, ask = asks(ALLOWED, [UNTOLD, UNTOLD])
    shortest = PITCH * 9.0 * DEG
    assert none is None
    assert isinstance(ask, Probe)
    assert ask.size == pytest.approx(2.0 * shortest)
    assert ask.places == pytest.approx((0.5, 0.0, 1.0, 0.5, 1.0, 0.0))
    assert ask.teaches


@given(st.floats(1e-9, 1e-6), st.floats(1e-4, 0.1), st.floats(0.0, 20.0 * DEG), st.floats(0.0, 1e-4))
def test_every_move_crosses_the_gap_and_the_lengths_differ_by_enough(
    noise: float, needed: float, widest: float, slack: float
) -> None:
    seen = replace(UNTOLD, ratio=UnknownRatio(0.1, needed, widest), noise=noise, slack=slack)
    _, ask = asks(replace(ALLOWED, probe=1.0), [seen, seen])
    assert isinstance(ask, Probe)
    places = [share * ask.size for share in (0.0, *ask.places)]
    lengths = [abs(b - a) for a, b in pairwise(places)]
    assert min(lengths) >= (slack + PITCH * (widest + 5.0 * DEG)) * (1.0 - 1e-9)
    assert max(lengths) - min(lengths) >= 4.0 * noise / needed * (1.0 - 1e-9)
    turns = [(b - a) * (d - c) for (a, b), (c, d) in pairwise(pairwise(places))]
    assert max(turns) < 0.0


@pytest.mark.parametrize(
    ("settings", "seen", "state", "prevented"),
    [
        (ExcitationSettings(), UNTOLD, ExcitationState(), "a probing move is not allowed"),
        (ExcitationSettings(probe=9e-5), UNTOLD, ExcitationState(), "at most 0.09 mm are allowed"),
        (ALLOWED, replace(UNTOLD, noise=math.nan), ExcitationState(), "not bounded well enough"),
        (ALLOWED, UNTOLD, ExcitationState(teaching=Stage.REFUSED), "this edge refuses probing moves"),
        (ALLOWED, UNTOLD, ExcitationState(probed=-1.0, lessons=3), "3 probing moves of different lengths did not"),
    ],
)
def test_what_prevents_them_is_told(
    settings: ExcitationSettings, seen: WindowSummary, state: ExcitationState, prevented: str
) -> None:
    decision = run(settings, [seen, seen], state)[-1]
    assert decision.ask is None
    assert prevented in decision.prevented
    assert decision.reason.endswith(decision.prevented)


def test_they_wait_for_the_pause_between_two_moves_which_prevents_nothing() -> None:
    decision = run(ALLOWED, [replace(UNTOLD, time=50.0)] * 2, ExcitationState(probed=0.0))[-1]
    assert (decision.ask, decision.prevented) == (None, "")
    assert "60 s must lie between two" in decision.reason


def test_each_move_in_vain_doubles_the_pause_before_the_next() -> None:
    state = ExcitationState(probed=0.0, lessons=5)
    early, late = (run(ALLOWED, [replace(UNTOLD, time=time)] * 2, state)[-1] for time in (32 * 59.0, 32 * 61.0))
    assert early.ask is None
    assert isinstance(late.ask, Probe)


def test_lessons_count_until_a_window_tells_the_ratio_and_probes_for_the_gap_are_apart() -> None:
    ask = asks(ALLOWED, [UNTOLD] * 2)[-1]
    assert isinstance(ask, Probe)
    state = ExcitationState().answered(ask, RequestOutcome.ACCEPTED)
    assert (state.lessons, state.teaching, state.probing) == (1, Stage.ACCEPTED, Stage.OPEN)
    refused = ExcitationState().answered(ask, RequestOutcome.TOO_LARGE)
    assert (refused.lessons, refused.teaching, refused.probing) == (0, Stage.REFUSED, Stage.OPEN)
    known = replace(LONG, status=GapStatus.OK)
    assert run(ALLOWED, [known], state)[-1].state.lessons == 1
    assert run(ALLOWED, [replace(known, taught=True)], state)[-1].state.lessons == 0
