"""The store, on SQLite and on PostgreSQL: once, in order, as a whole or not at all."""

import threading

import pytest
import sqlalchemy as sa
from store_cases import bodies_of, claim, letter, outcome, verification, window

from servotwin.errors import InvalidInput
from servotwin.store.engine import transaction
from servotwin.store.leases import MAX_LEASE_BYTES
from servotwin.store.records import Backlog, EvidenceRecord, Lease, MessageKind, OutgoingMessage, PutResult
from servotwin.store.schema import bodies, contexts, evidence, messages, outgoing, twins
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

NEW, KNOWN, CONFLICT = PutResult.NEW, PutResult.KNOWN, PutResult.CONFLICT


def rows(store: Store, table: sa.Table) -> int:
    with transaction(store.engines.reader) as connection:
        return connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one()


@pytest.mark.slow
def test_a_message_is_kept_once(store: Store) -> None:
    assert store.put([window(), window(sequence=2), window("b")]) == [NEW, NEW, NEW]
    assert store.put([window(), window(sequence=3)]) == [KNOWN, NEW]
    assert store.put([]) == []
    assert rows(store, messages) == rows(store, bodies) == 4


def test_copies_within_a_batch(store: Store) -> None:
    other = window(body=b"other samples")
    assert store.put([window(), window(), other]) == [NEW, KNOWN, CONFLICT]
    assert bodies_of(claim(store)[0]) == [b"samples"]


def test_the_same_key_with_another_digest_is_a_conflict_and_the_first_stays(store: Store) -> None:
    store.put([window()])
    assert store.put([window(body=b"other")]) == [CONFLICT]
    assert store.window("a", "boot", 1).body == b"samples"
    reencoded = window()._replace(body=b"packed", encoding="zstd")
    assert store.put([reencoded]) == [KNOWN]


def test_a_lease_contains_windows_and_letters_in_order_and_is_granted_once(store: Store) -> None:
    store.put([letter(body=b"first"), window("b")])
    store.put([window(sequence=2, body=b"second"), window(sequence=1, body=b"third")])
    result = {one.servo: one for one in claim(store)}
    assert bodies_of(result["a"]) == [b"first", b"second", b"third"]
    assert [message.kind for message in result["a"].messages] == [
        MessageKind.LETTER,
        MessageKind.WINDOW,
        MessageKind.WINDOW,
    ]
    assert (result["a"].state, result["a"].serial, result["a"].attempts) == (b"", 0, 1)
    assert claim(store, "you") == []


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


def test_a_lease_ends_with_time_with_release_and_with_a_result(store: Store) -> None:
    store.put([window(), window("b")])
    assert len(claim(store, lease_s=30.0, now=200.0)) == 2
    assert claim(store, "you", now=229.0) == []
    assert {one.attempts for one in claim(store, "you", now=231.0)} == {2}
    store.release("me")
    assert claim(store, "me", now=232.0) == []
    store.release("you", ["b"])
    (again,) = claim(store, "me", now=233.0)
    assert (again.servo, again.attempts) == ("b", 3)
    store.commit([outcome(again)], 234.0)
    store.put([window("b", 2)])
    (fresh,) = claim(store, "you", now=235.0)
    assert (fresh.servo, fresh.serial, fresh.attempts, fresh.state) == ("b", 1, 1, b"state")


def test_a_servo_is_leased_when_its_wake_up_is_due(store: Store) -> None:
    store.put([window(), window("b")])
    first = {one.servo: one for one in claim(store)}
    store.commit([outcome(first["a"], wake=300.0), outcome(first["b"])], 201.0)
    assert claim(store, now=299.0) == []
    assert claim(store, now=300.0, kinds=(MessageKind.VERIFICATION,)) == []
    (woken,) = claim(store, now=300.0)
    assert (woken.servo, woken.messages) == ("a", ())


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


def test_messages_from_before_a_clock_was_set_back_are_leased(store: Store) -> None:
    store.put([window(received=9000.0)])
    assert len(claim(store, now=200.0)) == 1
    assert store.backlog(200.0) == Backlog(1, 0, 0.0)


def test_a_lease_from_before_a_clock_was_set_back_has_ended(store: Store) -> None:
    store.put([window()])
    assert len(claim(store, now=9000.0)) == 1
    assert claim(store, "you", now=8980.0) == []
    assert len(claim(store, "you", now=200.0)) == 1
    assert claim(store, now=201.0) == []


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


def test_the_second_of_two_results_of_one_lease_is_void(store: Store) -> None:
    store.put([window(), window("b")])
    a, b = claim(store)
    late = outcome(a, EvidenceRecord("estimate", a.messages[0].id, b"2"), outgoing=(b"2",), state=b"2")
    first = outcome(a, EvidenceRecord("estimate", a.messages[0].id, b"1"), outgoing=(b"1",), state=b"1")
    assert store.commit([first, late, outcome(b)], 201.0) == [True, False, True]
    assert store.commit([late], 202.0) == [False]
    assert store.outgoing("a", 0) == [OutgoingMessage(1, b"1")]
    assert rows(store, evidence) == 1
    store.put([window(sequence=2)])
    assert claim(store)[0].state == b"1"


def test_a_result_for_an_unknown_servo_is_void(store: Store) -> None:
    assert store.commit([outcome(Lease("nobody", b"", 0, ()))], 200.0) == [False]


@pytest.mark.parametrize("fault", ["context", "message", "foreign message", "done message"])
def test_an_invalid_result_leaves_nothing_behind(store: Store, fault: str) -> None:
    store.put([window(), window("b")])
    a, b = sorted(claim(store))
    faulty = outcome(
        a, EvidenceRecord("estimate", 0, b"", context="nowhere" if fault == "context" else ""), outgoing=(b"u",)
    )
    if fault == "done message":
        store.commit([outcome(a)], 201.0)
        faulty = faulty._replace(serial=1)
    elif fault != "context":
        other = b.messages[0].id if fault == "foreign message" else 999_999
        faulty = faulty._replace(done=(*faulty.done, other))
    for together in ([faulty], [faulty, outcome(b)]):
        with pytest.raises((ValueError, sa.exc.IntegrityError)):
            store.commit(together, 201.0)
    assert rows(store, evidence) == rows(store, outgoing) == rows(store, contexts) == 0
    assert store.servo("a").serial == (fault == "done message")
    assert store.servo("b").serial == 0


def test_many_threads_with_the_same_windows_keep_each_once(store: Store) -> None:
    became: list[list[PutResult]] = []
    barrier = threading.Barrier(4)

    def send() -> None:
        barrier.wait()
        batches = ([window("ab"[n % 2], n) for n in range(first, first + 8)] for first in range(0, 40, 8))
        became.extend(store.put(batch) for batch in batches)

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    flat = [put for puts in became for put in puts]
    assert flat.count(NEW) == rows(store, messages) == 40
    assert flat.count(KNOWN) == 120


def test_leases_of_many_threads_do_not_overlap(store: Store) -> None:
    names = [f"s{n}" for n in range(40)]
    store.put([window(name) for name in names])
    leased: list[str] = []

    def borrow(owner: str) -> None:
        while result := claim(store, owner, limit=3):
            leased.extend(one.servo for one in result)

    threads = [threading.Thread(target=borrow, args=(f"owner {n}",)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # A row that another thread holds is passed over: what is left then is for the next one who asks.
    leased.extend(one.servo for one in claim(store, "last", limit=40))
    assert sorted(leased) == sorted(names)


def test_a_message_that_arrives_while_its_servo_is_leased_is_not_lost(store: Store) -> None:
    store.put([window()])
    (leased,) = claim(store)
    store.put([window(sequence=2)])
    store.commit([outcome(leased)], 201.0)
    (again,) = claim(store)
    assert (again.serial, len(again.messages)) == (1, 1)


def test_no_message_is_lost_when_results_and_messages_are_committed_at_once(store: Store) -> None:
    total, done = 150, threading.Event()

    def send() -> None:
        for sequence in range(total):
            store.put([window(sequence=sequence)])
        done.set()

    sender = threading.Thread(target=send)
    sender.start()
    taken, idle = 0, 0
    while idle < 2:
        finished = done.is_set()
        result = claim(store, per_servo=4)
        assert store.commit([outcome(one) for one in result], 201.0) == [True] * len(result)
        taken += sum(len(one.messages) for one in result)
        idle = idle + 1 if finished and not result else 0
    sender.join()
    assert taken == total


@pytest.mark.slow
@pytest.mark.parametrize("url", ["mysql://u:secret@h/d", "postgresql://u:secret@h:port/d", "http://secret@h/d", ""])
def test_an_invalid_address_is_refused_without_showing_its_password(url: str) -> None:
    with pytest.raises(InvalidInput, match=r"the store's address") as refused:
        open_store(url)
    assert "secret" not in str(refused.value)


def test_when_all_is_done_nothing_is_marked_as_waiting(store: Store) -> None:
    """Or each claim would lend servos in vain for ever."""
    store.put([window()])
    (leased,) = claim(store)
    store.commit([outcome(leased, enqueue=(verification(),))], 201.0)
    (verification_lease,) = claim(store, kinds=(MessageKind.VERIFICATION,))
    store.commit([outcome(verification_lease)], 202.0)
    with transaction(store.engines.reader) as connection:
        assert connection.execute(sa.select(twins.c.ready, twins.c.verification_ready)).all() == [(None, None)]


class Deadlock(Exception):
    """As PostgreSQL's driver tells it."""

    sqlstate = "40P01"


def test_a_transaction_that_lost_a_race_is_retried(store: Store) -> None:
    failures = iter([Deadlock("deadlock detected")] * 2)

    def fail(*_: object) -> None:
        for failure in failures:
            raise sa.exc.OperationalError("INSERT", None, failure)

    sa.event.listen(store.engines.writer, "before_cursor_execute", fail)
    assert store.put([window()]) == [NEW]
    sa.event.remove(store.engines.writer, "before_cursor_execute", fail)
    assert next(failures, None) is None
    assert rows(store, messages) == 1


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


def test_a_lease_lasts_as_long_as_it_is_renewed(store: Store) -> None:
    store.put([window(), window("b")])
    claim(store, now=200.0, lease_s=30.0)
    store.renew("me", ["a"], 260.0)
    store.renew("you", ["b"], 260.0)
    assert [each.servo for each in claim(store, "you", now=240.0)] == ["b"]


def test_a_servo_on_hold_waits(store: Store) -> None:
    store.put([window(), window("b")])
    store.hold("a", 220.0)
    assert [each.servo for each in claim(store, now=210.0)] == ["b"]
    store.hold("b", 500.0)  # it is leased: nothing changes
    assert [each.servo for each in claim(store, now=221.0)] == ["a"]
    assert [each.servo for each in claim(store, "you", now=241.0)] == ["b"]
