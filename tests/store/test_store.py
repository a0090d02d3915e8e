"""The store, on SQLite and on PostgreSQL: once, in order, as a whole or not at all."""

import threading

import pytest
import sqlalchemy as sa
from store_cases import bodies_of, claim, letter, outcome, verification, window

from servotwin.errors import InvalidInput
from servotwin.store.engine import transaction
from servotwin.store.leases import LONGEST_HOLD_S
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


def test_a_servo_may_be_held_for_much_longer_than_a_lease(store: Store) -> None:
    store.put([window()])
    store.hold("a", 200.0 + LONGEST_HOLD_S)
    assert claim(store, now=199.0 + LONGEST_HOLD_S, lease_s=1.0) == claim(store, now=200.0, lease_s=1.0) == []
    assert len(claim(store, now=200.0 + LONGEST_HOLD_S, lease_s=1.0)) == 1


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


@pytest.mark.slow
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
