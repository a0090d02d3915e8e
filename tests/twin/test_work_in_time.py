"""What a worker leaves undone where more arrives than can be worked off."""

import msgspec
import pytest
from leases import QUICK, START, claim, fleet, kinds, receipt, windows

from servotwin.messages import (
    Hello,
    Reason,
    Update,
    decode,
)
from servotwin.store.records import WorkResult
from servotwin.twin.settings import TriageSettings
from servotwin.twin.work import Urgency, work


def redesigns(outcome: WorkResult) -> dict[int, str]:
    return {row.message: row.status for row in outcome.evidence if row.kind == "redesign"}


def test_of_the_windows_that_wait_only_the_newest_changes_the_setting():
    outcome = work(fleet(), claim(*windows()[:3], received=[0.0, 0.0, 0.0]), 0.1, Urgency())
    assert [kinds(outcome, n).count("estimate") for n in (1, 2, 3)] == [1, 1, 1]
    assert [decode(update).window for update in outcome.outgoing] == [(windows()[2].boot, windows()[2].sequence)]
    assert {n: why[:14] for n, why in redesigns(outcome).items()} == {1: "a newer window", 2: "a newer window", 3: ""}
    assert outcome.done == (1, 2, 3)


def test_a_window_that_was_overtaken_before_changes_nothing_and_no_summary():
    first = work(fleet(), claim(windows()[2]), 0.1, Urgency())
    late = work(fleet(), claim(*windows()[:2], state=first.state, serial=1), 0.2, Urgency())
    assert late.outgoing == ()
    assert {why[:14] for why in redesigns(late).values()} == {"a newer window"}
    assert all(row.overtaken for row in late.evidence)
    assert not any(row.overtaken for row in first.evidence)
    # Without the need to hurry all of them have their say.
    plain_first = work(fleet(), claim(windows()[0]), 0.1)
    assert work(fleet(), claim(windows()[1], state=plain_first.state, serial=1), 0.2).outgoing


def test_with_triage_a_window_that_was_overtaken_gets_a_glance_only():
    quick = fleet(triage=TriageSettings())
    outcome = work(quick, claim(*windows()[:3], received=[0.0, 0.0, 0.0]), 0.1, Urgency())
    assert [kinds(outcome, n) for n in (1, 2)] == [["glance"], ["glance"]]
    assert kinds(outcome, 3)[:2] == ["glance", "estimate"]
    assert len(outcome.outgoing) == 1


def test_a_window_for_which_a_glance_does_not_do_waits_for_a_turn_of_its_own_and_then_gives_the_same():
    quick, lease = fleet(triage=TriageSettings()), claim(*windows()[:3], received=[0.0, 0.0, 0.0])
    at_once = work(quick, lease, 0.1, Urgency())
    glanced = work(quick, lease, 0.1, Urgency(defer=True))
    assert (glanced.done, glanced.deferred, glanced.outgoing) == ((1, 2), 3, ())
    assert [kinds(glanced, n) for n in (1, 2, 3)] == [["glance"], ["glance"], []]
    left = claim(windows()[2], state=glanced.state, serial=1, received=[0.0])._replace(estimate=True)
    [message] = left.messages
    left = left._replace(messages=(message._replace(id=3),))
    later = work(quick, left, 0.1, Urgency(defer=True))
    assert (later.done, later.deferred) == ((3,), 0)
    assert (later.state, later.outgoing) == (at_once.state, at_once.outgoing)
    assert later.evidence == tuple(row for row in at_once.evidence if row.message == 3)


def test_a_deferred_window_that_is_overtaken_before_its_turn_gets_a_glance_only():
    quick = fleet(triage=TriageSettings())
    glanced = work(quick, claim(windows()[1], received=[0.0]), 0.1, Urgency(defer=True))
    assert (glanced.done, glanced.deferred, glanced.evidence) == ((), 1, ())
    lease = claim(*windows()[1:3], state=glanced.state, serial=1, received=[0.0, 0.0])
    again = work(quick, lease, 0.2, Urgency(defer=True))
    assert (again.done, again.deferred, kinds(again, 1)) == ((1,), 2, ["glance"])


def test_without_triage_no_window_is_deferred_and_other_work_leaves_what_was_deferred():
    outcome = work(fleet(), claim(windows()[0], received=[0.0]), 0.1, Urgency(defer=True))
    assert (outcome.done, outcome.deferred) == ((1,), 0)
    assert work(fleet(), claim(state=outcome.state, serial=1), 0.2, Urgency(defer=True)).deferred is None


def test_while_other_servos_wait_an_overtaken_window_is_stored_only():
    outcome = work(fleet(), claim(*windows()[:3], received=[0.0, 0.0, 0.0]), 0.1, Urgency(others_wait=True))
    assert [kinds(outcome, n) for n in (1, 2)] == [["glance"], ["glance"]]
    assert {row.status[:14] for row in outcome.evidence if row.message < 3} == {"a newer window"}
    assert "estimate" in kinds(outcome, 3)
    assert len(outcome.outgoing) == 1


@pytest.mark.parametrize("introduced", [True, False])
def test_a_window_of_an_ended_boot_that_comes_last_costs_the_live_one_no_update(introduced):
    """Two boots in one lease: the twin has asked for windows of the ended one again."""
    ended, live = windows()[0], msgspec.structs.replace(windows()[2], boot="live")
    state = b""
    if introduced:
        hello = Hello("axis", "live", live.start, live.rate, 0, START, "m", 2)
        state = work(fleet(), claim(hello), 0.0).state
        ended = msgspec.structs.replace(ended, boot="unknown")
    else:
        state = work(fleet(), claim(ended), 0.0).state
        state = work(
            fleet(), claim(msgspec.structs.replace(windows()[1], boot="live"), state=state, serial=1), 0.0
        ).state
        ended = msgspec.structs.replace(ended, sequence=77)
    outcome = work(fleet(), claim(live, ended, state=state, serial=2, received=[1e3, 1e3]), 1e3, Urgency())
    [update] = [each for each in map(decode, outcome.outgoing) if isinstance(each, Update)]
    assert update.window == ("live", live.sequence)
    assert [row.message for row in outcome.evidence if row.overtaken and row.kind == "estimate"] == [2]


def test_a_hello_in_the_lease_tells_the_live_boot():
    hello = Hello("axis", windows()[0].boot, 0.0, windows()[0].rate, 0, START, "m", 2)
    state = work(fleet(), claim(hello, windows()[0]), 0.0).state
    live = msgspec.structs.replace(windows()[2], boot="live")
    batch = claim(
        msgspec.structs.replace(hello, boot="live"), live, windows()[1], state=state, serial=1, received=[1e3] * 3
    )
    [update] = [each for each in map(decode, work(fleet(), batch, 1e3, Urgency()).outgoing) if isinstance(each, Update)]
    assert update.window[0] == "live"


def test_no_setting_is_computed_that_would_come_too_late():
    window = windows()[1]
    spent = window.samples / window.rate
    in_time, late = 100.0 + QUICK.valid_for - spent - 0.5, 100.0 + QUICK.valid_for - spent + 0.5
    sent = claim(window, received=[100.0])
    assert work(fleet(), sent, in_time, Urgency()).outgoing
    assert work(fleet(), sent, in_time, Urgency(expected_s=1.0)).outgoing == ()
    outcome = work(fleet(), sent, late, Urgency())
    assert outcome.outgoing == ()
    assert redesigns(outcome)[1].startswith("too late by 0.5 s: an update may be applied for 60 s")
    assert "estimate" in kinds(outcome, 1)
    assert work(fleet(), sent, late, Urgency(speed=0.5)).outgoing
    assert work(fleet(), sent, late).outgoing


def test_a_receipt_is_processed_before_the_window_that_came_first():
    first = work(fleet(), claim(windows()[1], received=[100.0]), 100.0, Urgency())
    in_force = windows()[1].parameter_version
    refused = receipt(decode(first.outgoing[0]), Reason.STEP_TOO_LARGE, in_force)
    next_window = msgspec.structs.replace(windows()[2], parameter_version=in_force)
    both = claim(next_window, refused, state=first.state, serial=1, received=[101.0, 102.0])
    (update,) = map(decode, work(fleet(), both, 102.0, Urgency()).outgoing)
    assert update.base_version == in_force
