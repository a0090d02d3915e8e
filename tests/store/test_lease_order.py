"""Whose messages a lease takes, and which, on SQLite and on PostgreSQL."""

import pytest
from store_cases import bodies_of, claim, letter, outcome, verification, window

from servotwin.store.leases import MAX_LEASE_BYTES
from servotwin.store.records import Backlog, MessageKind
from servotwin.store.store import Store

pytest_plugins = ("store_fixtures",)


def test_the_servo_that_waited_longest_is_leased_first_within_the_limits(store: Store) -> None:
    store.put([window("late", received=120.0), window("early", received=90.0), window("middle", received=100.0)])
    store.put([window("early", sequence) for sequence in range(2, 6)])
    assert [one.servo for one in claim(store, limit=2)] == ["early", "middle"]
    store.release("me")
    (early,) = claim(store, limit=1, per_servo=3)
    assert [message.id for message in early.messages] == sorted(message.id for message in early.messages)
    assert len(early.messages) == 3
    assert store.commit([outcome(early)], 201.0) == [True]
    (rest,) = claim(store, servo="early")
    assert len(rest.messages) == 2


def test_new_messages_of_others_come_before_windows_that_were_overtaken(store: Store) -> None:
    """These come ten seconds later, or when a worker is idle; beside new ones of their servo they go along."""
    store.put(
        [window("a", received=150.0)._replace(overtaken=True), window("b", received=159.0), window("c", received=161.0)]
    )
    assert [one.servo for one in claim(store, limit=1, now=159.0)] == ["b"]
    assert store.turn_lag(159.5) == 0.5  # of b, which is worked on
    assert [one.servo for one in claim(store, limit=1, now=159.5)] == ["a"]
    store.release("me")
    assert store.turn_lag(165.0) == 6.0
    assert [one.servo for one in claim(store, limit=3, now=165.0)] == ["b", "a", "c"]


def test_a_servo_is_leased_when_its_wake_up_is_due(store: Store) -> None:
    store.put([window(), window("b")])
    first = {one.servo: one for one in claim(store)}
    store.commit([outcome(first["a"], wake=300.0), outcome(first["b"])], 201.0)
    assert claim(store, now=299.0) == []
    assert claim(store, now=300.0, kinds=(MessageKind.VERIFICATION,)) == []
    (woken,) = claim(store, now=300.0)
    assert (woken.servo, woken.messages) == ("a", ())


def test_a_wake_up_that_was_set_under_a_clock_far_ahead_is_due_once_the_clock_is_right(store: Store) -> None:
    """The twin's repetition of an update, or of a request, waited until then."""
    store.put([window(), window("b")])
    year = 365.0 * 86400.0
    store.commit([outcome(one, wake=year + 5.0) for one in claim(store)], year)
    woken = claim(store, limit=1, now=300.0) + claim(store, now=300.0)
    assert [(one.servo, one.messages) for one in woken] == [("a", ()), ("b", ())]
    store.commit([outcome(one, wake=305.0) for one in woken], 300.0)
    assert claim(store, now=304.0) == []
    assert len(claim(store, now=305.0)) == 2


def test_servos_to_be_woken_do_not_crowd_out_messages_nor_the_reverse(store: Store) -> None:
    for servo in ("w1", "w2", "w3"):
        store.put([window(servo)])
    store.commit([outcome(one, wake=150.0) for one in claim(store)], 201.0)
    store.put([window(servo) for servo in ("m1", "m2", "m3")])
    servos = [one.servo for one in claim(store, limit=4)]
    assert len([servo for servo in servos if servo.startswith("w")]) == 2
    assert len([servo for servo in servos if servo.startswith("m")]) == 2


def test_a_single_place_goes_to_whoever_waited_longest(store: Store) -> None:
    """Otherwise servos whose updates wait for receipts would starve those that never had a turn."""
    store.put([window("w")])
    store.commit([outcome(one, wake=150.0) for one in claim(store)], 201.0)
    store.put([window("m", received=140.0), window("late", received=160.0)])
    assert [claim(store, limit=1)[0].servo for _ in range(3)] == ["m", "w", "late"]
    assert claim(store, limit=1) == []


def deferred(store: Store, *servos: str, now: float) -> None:
    """Take these servos' turns; the newest window of each needs an estimate."""
    for servo in servos:
        (one,) = claim(store, servo=servo, now=now)
        *done, last = (message.id for message in one.messages)
        assert store.commit([outcome(one)._replace(done=tuple(done), deferred=last)], now) == [True]


def test_new_messages_come_before_deferred_estimates_and_those_before_backlogs(store: Store) -> None:
    store.put([window("backlog", sequence) for sequence in range(3)])
    (one,) = claim(store, newest_first=True, per_servo=1)
    store.commit([outcome(one, deferred=0)], 200.0)
    store.put([window("a"), window("b")])
    deferred(store, "a", now=201.0)
    deferred(store, "b", now=202.0)
    store.put([window("new", received=203.0)])
    turns = [claim(store, now=204.0, limit=4) for _ in range(4)]
    assert [[(lease.servo, lease.estimate) for lease in turn] for turn in turns] == [
        [("new", False)], [("a", True)], [("b", True)], [("backlog", False)],
    ]  # fmt: skip
    assert claim(store, now=204.0) == []


def test_estimates_can_be_given_a_turn_before_new_messages(store: Store) -> None:
    store.put([window("a")])
    deferred(store, "a", now=201.0)
    store.put([window("new")])
    turns = [claim(store, now=204.0, estimate_first=True) for _ in range(2)]
    assert [[(lease.servo, lease.estimate) for lease in turn] for turn in turns] == [[("a", True)], [("new", False)]]


def test_a_servo_keeps_its_place_among_the_estimates_although_newer_windows_come(store: Store) -> None:
    store.put([window("a"), window("b")])
    deferred(store, "a", now=201.0)
    deferred(store, "b", now=202.0)
    store.put([window("a", 2)])
    deferred(store, "a", now=203.0)
    assert store.backlog(211.0).lag == 10.0
    (first,) = claim(store, now=204.0)
    assert (first.servo, first.estimate, [message.key for message in first.messages]) == ("a", True, ["boot/2"])
    store.put([verification("a")])
    store.commit([outcome(first, deferred=0)], 205.0)
    (second,) = claim(store, now=206.0)
    assert (second.servo, second.estimate) == ("b", True)


def test_a_verification_leaves_the_place_among_the_estimates(store: Store) -> None:
    store.put([window("a")])
    deferred(store, "a", now=201.0)
    store.put([window("new", received=202.0), verification("a")])
    (proof,) = claim(store, kinds=(MessageKind.VERIFICATION,), now=204.0)
    store.commit([outcome(proof)], 205.0)
    turns = [claim(store, now=206.0) for _ in range(2)]
    assert [[(lease.servo, lease.estimate) for lease in turn] for turn in turns] == [[("new", False)], [("a", True)]]


@pytest.mark.slow
def test_large_messages_are_leased_a_few_at_a_time(store: Store) -> None:
    large, small = b"x" * (MAX_LEASE_BYTES // 2), b"y"
    store.put([window("a", sequence, large) for sequence in range(3)])
    store.put([window("a", 3, small), window("b", 0, large + large + small), window("b", 1, small)])
    one, other = store.lease("me", 10, 60.0, 200.0)
    assert [message.key for message in one.messages] == ["boot/0", "boot/1"]
    assert [message.key for message in other.messages] == ["boot/0"]
    assert store.commit([outcome(one), outcome(other)], 200.0) == [True, True]
    one, other = store.lease("me", 10, 60.0, 200.0)
    assert [message.key for message in one.messages] == ["boot/2", "boot/3"]
    assert [message.body for message in other.messages] == [small]


def test_verifications_are_leased_only_on_request(store: Store) -> None:
    store.put([window()])
    (leased,) = claim(store)
    assert store.commit([outcome(leased, enqueue=(verification(), verification(body=b"another")))], 201.0) == [True]
    assert claim(store) == []
    assert store.backlog(202.0) == Backlog(0, 2, 0.0)
    (verification_lease,) = claim(store, kinds=(MessageKind.VERIFICATION,), per_servo=1)
    assert bodies_of(verification_lease) == [b"prove it"]
    store.put([window(sequence=2)])
    assert claim(store, "you") == []
    assert store.commit([outcome(verification_lease)], 202.0) == [True]
    (both,) = claim(store, kinds=tuple(MessageKind))
    assert sorted(bodies_of(both)) == [b"another", b"samples"]


def test_a_lease_of_one_kind_skips_servos_without_such_messages(store: Store) -> None:
    store.put([window(), letter("b")])
    (only,) = claim(store, kinds=(MessageKind.LETTER,))
    assert only.servo == "b"
    assert [one.servo for one in claim(store, "you")] == ["a"]


def test_the_newest_windows_are_leased_first_and_every_letter(store: Store) -> None:
    store.put([letter(), *(window(sequence=n, body=b"%d" % n) for n in range(5)), letter(body=b"receipt")])
    (leased,) = claim(store, per_servo=2, newest_first=True)
    assert bodies_of(leased) == [b"hello", b"3", b"4", b"receipt"]
    store.commit([outcome(leased)], 201.0)
    (rest,) = claim(store, per_servo=2, newest_first=True)
    assert bodies_of(rest) == [b"1", b"2"]


def test_the_newest_windows_are_leased_as_far_as_a_lease_has_room(store: Store) -> None:
    half = MAX_LEASE_BYTES // 2
    store.put([window("a", n, b"%d" % n + b"x" * half) for n in range(3)])
    (leased,) = claim(store, newest_first=True)
    assert [message.key for message in leased.messages] == ["boot/2"]


def test_new_messages_of_others_come_before_the_rest_of_a_backlog(store: Store) -> None:
    store.put([window("a", n, received=100.0 + n) for n in range(5)])
    store.put([window("b", received=150.0)])
    (first,) = claim(store, limit=1, per_servo=2, newest_first=True)
    assert first.servo == "a"
    store.commit([outcome(first)], 201.0)
    assert store.backlog(210.0) == Backlog(4, 0, 110.0, 60.0)
    assert [each.servo for each in claim(store, limit=1, now=202.0)] == ["b"]
    assert [each.servo for each in claim(store, limit=1, now=202.0)] == ["a"]
    store.release("me")
    # A window that comes while its servo's backlog waits has its own place again.
    store.put([window("a", 9, received=149.0)])
    assert [each.servo for each in claim(store, limit=1, now=203.0)] == ["a"]


def test_what_came_during_the_work_is_no_backlog(store: Store) -> None:
    store.put([window("a", received=100.0)])
    (leased,) = claim(store)
    store.put([window("a", 2, received=201.0)])
    store.commit([outcome(leased)], 202.0)
    assert store.backlog(205.0) == Backlog(1, 0, 4.0, 4.0)
