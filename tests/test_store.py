"""The store, on SQLite and on PostgreSQL: once, in order, as a whole or not at all."""

import threading
from collections.abc import Callable, Iterator

import pytest
import sqlalchemy as sa
from store_cases import SYSTEMS, addresses, letter, outcome, proof, window

from servotwin.errors import InvalidInput
from servotwin.store.engine import transaction
from servotwin.store.rows import Claim, Evidence, Kind, Posted, Put, Waiting
from servotwin.store.schema import bodies, contexts, evidence, messages, metadata, outgoing
from servotwin.store.store import Store, open_store

NewAddress = Callable[[], str]
NEW, KNOWN, CONFLICT = Put.NEW, Put.KNOWN, Put.CONFLICT


@pytest.fixture(scope="module", params=SYSTEMS)
def new_address(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[], str]]:
    with addresses(request.param, tmp_path_factory.mktemp("stores")) as found:
        yield found


@pytest.fixture(scope="module")
def opened(new_address: NewAddress) -> Iterator[Store]:
    store = open_store(new_address())
    yield store
    store.close()


@pytest.fixture
def store(opened: Store) -> Store:
    """An empty one."""
    with transaction(opened.engines.writer) as connection:
        for table in reversed(metadata.sorted_tables):
            connection.execute(sa.delete(table))
    return opened


def rows(store: Store, table: sa.Table) -> int:
    with transaction(store.engines.reader) as connection:
        return connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one()


def bodies_of(claim: Claim) -> list[bytes]:
    return [message.body for message in claim.messages]


def claim(store: Store, owner: str = "me", now: float = 200.0, **more: object) -> list[Claim]:
    return store.claim(owner, more.pop("limit", 10), more.pop("lease_s", 30.0), now, **more)


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


def test_a_claim_holds_windows_and_letters_in_order_and_is_lent_once(store: Store) -> None:
    store.put([letter(body=b"first"), window("b")])
    store.put([window(sequence=2, body=b"second"), window(sequence=1, body=b"third")])
    found = {one.servo: one for one in claim(store)}
    assert bodies_of(found["a"]) == [b"first", b"second", b"third"]
    assert [message.kind for message in found["a"].messages] == [Kind.LETTER, Kind.WINDOW, Kind.WINDOW]
    assert (found["a"].state, found["a"].serial, found["a"].attempts) == (b"", 0, 1)
    assert claim(store, "you") == []


def test_who_waited_longest_comes_first_and_limits_hold(store: Store) -> None:
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


def test_a_lease_ends_with_time_with_release_and_with_an_outcome(store: Store) -> None:
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


def test_a_servo_is_woken_when_it_is_time(store: Store) -> None:
    store.put([window(), window("b")])
    first = {one.servo: one for one in claim(store)}
    store.commit([outcome(first["a"], wake=300.0), outcome(first["b"])], 201.0)
    assert claim(store, now=299.0) == []
    assert claim(store, now=300.0, kinds=(Kind.PROOF,)) == []
    (woken,) = claim(store, now=300.0)
    assert (woken.servo, woken.messages) == ("a", ())


def test_those_to_be_woken_do_not_crowd_out_messages_nor_the_reverse(store: Store) -> None:
    for servo in ("w1", "w2", "w3"):
        store.put([window(servo)])
    store.commit([outcome(one, wake=150.0) for one in claim(store)], 201.0)
    store.put([window(servo) for servo in ("m1", "m2", "m3")])
    servos = [one.servo for one in claim(store, limit=4)]
    assert len([servo for servo in servos if servo.startswith("w")]) == 2
    assert len([servo for servo in servos if servo.startswith("m")]) == 2


def test_messages_from_before_a_clock_was_set_back_are_claimed(store: Store) -> None:
    store.put([window(received=9000.0)])
    assert len(claim(store, now=200.0)) == 1
    assert store.waiting(200.0) == Waiting(1, 0, 0.0)


def test_a_lease_from_before_a_clock_was_set_back_has_ended(store: Store) -> None:
    store.put([window()])
    assert len(claim(store, now=9000.0)) == 1
    assert claim(store, "you", now=8980.0) == []
    assert len(claim(store, "you", now=200.0)) == 1
    assert claim(store, now=201.0) == []


def test_proofs_are_claimed_only_when_asked_for(store: Store) -> None:
    store.put([window()])
    (lent,) = claim(store)
    assert store.commit([outcome(lent, enqueue=(proof(), proof(body=b"another")))], 201.0) == [True]
    assert claim(store) == []
    assert store.waiting(202.0) == Waiting(0, 2, 0.0)
    (asked,) = claim(store, kinds=(Kind.PROOF,), per_servo=1)
    assert bodies_of(asked) == [b"prove it"]
    store.put([window(sequence=2)])
    assert claim(store, "you") == []
    assert store.commit([outcome(asked)], 202.0) == [True]
    (both,) = claim(store, kinds=tuple(Kind))
    assert sorted(bodies_of(both)) == [b"another", b"samples"]


def test_a_claim_of_one_kind_lends_nothing_in_vain(store: Store) -> None:
    store.put([window(), letter("b")])
    (only,) = claim(store, kinds=(Kind.LETTER,))
    assert only.servo == "b"
    assert [one.servo for one in claim(store, "you")] == ["a"]


def test_of_two_outcomes_of_one_claim_the_second_is_void(store: Store) -> None:
    store.put([window(), window("b")])
    a, b = claim(store)
    late = outcome(a, Evidence("estimate", a.messages[0].id, b"2"), outgoing=(b"2",), state=b"2")
    first = outcome(a, Evidence("estimate", a.messages[0].id, b"1"), outgoing=(b"1",), state=b"1")
    assert store.commit([first, late, outcome(b)], 201.0) == [True, False, True]
    assert store.commit([late], 202.0) == [False]
    assert store.outgoing("a", 0) == [Posted(1, b"1")]
    assert rows(store, evidence) == 1
    store.put([window(sequence=2)])
    assert claim(store)[0].state == b"1"


def test_an_outcome_for_an_unknown_servo_is_void(store: Store) -> None:
    assert store.commit([outcome(Claim("nobody", b"", 0, ()))], 200.0) == [False]


@pytest.mark.parametrize("fault", ["context", "message", "foreign message"])
def test_a_faulty_outcome_leaves_nothing_behind(store: Store, fault: str) -> None:
    store.put([window(), window("b")])
    a, b = sorted(claim(store))
    faulty = outcome(a, Evidence("estimate", 0, b"", context="nowhere" if fault == "context" else ""), outgoing=(b"u",))
    if fault != "context":
        other = b.messages[0].id if fault == "foreign message" else 999_999
        faulty = faulty._replace(done=(*faulty.done, other))
    with pytest.raises((ValueError, sa.exc.IntegrityError)):
        store.commit([faulty, outcome(b)], 201.0)
    assert rows(store, evidence) == rows(store, outgoing) == rows(store, contexts) == 0
    assert {one.serial for one in claim(store, now=500.0)} == {0}
    assert len(claim(store, "you", now=900.0)) == 2


def test_serials_of_outgoing_messages_rise_per_servo(store: Store) -> None:
    for sequence in (1, 2):
        store.put([window(sequence=sequence), window("b", sequence)])
        store.commit([outcome(one, outgoing=(b"x%d" % sequence, b"y%d" % sequence)) for one in claim(store)], 201.0)
    assert store.outgoing("a", 0) == [Posted(1, b"x1"), Posted(2, b"y1"), Posted(3, b"x2"), Posted(4, b"y2")]
    assert store.outgoing("b", 2) == [Posted(3, b"x2"), Posted(4, b"y2")]
    assert store.outgoing("a", 0, limit=1) == [Posted(1, b"x1")]
    assert store.outgoing("a", 4) == store.outgoing("nobody", 0) == []


def test_what_waits_and_for_how_long(store: Store) -> None:
    assert store.waiting(200.0) == Waiting(0, 0, 0.0)
    store.put([window(received=110.0), letter(received=120.0), window("b", received=150.0)])
    assert store.waiting(200.0) == Waiting(3, 0, 90.0)
    store.commit([outcome(claim(store, servo="a")[0])], 201.0)
    assert store.waiting(200.0) == Waiting(1, 0, 50.0)


def test_contexts_are_kept_once(store: Store) -> None:
    store.put([window(), window("b")])
    known = (("k1", '{"numpy": "2"}'),)
    made = [outcome(one, Evidence("estimate", 0, b"", context="k1"), contexts=known) for one in claim(store)]
    assert store.commit(made, 201.0) == [True, True]
    assert store.contexts(["k1", "k2"]) == {"k1": '{"numpy": "2"}'}


def test_a_servo_at_a_glance(store: Store) -> None:
    store.put([window(), letter(received=150.0), window("b")])
    found = (
        Evidence("glance", 0, b"", gap=0.1, std=0.01, status="calm"),
        Evidence("estimate", 0, b"", gap=0.2, std=0.02, status="ok"),
        Evidence("update", 0, b"", version=3, gap=0.2),
        Evidence("receipt", 0, b"", version=3, status="applied"),
    )
    store.commit([outcome(claim(store, servo="a")[0], *found, outgoing=(b"u",), wake=400.0)], 201.0)
    store.put([window(sequence=2, received=160.0)])
    assert [one.servo for one in store.servos()] == ["a", "b"]
    assert [one.servo for one in store.servos(after="a")] == ["b"]
    a = store.servo("a")
    assert (a.serial, a.windows, a.waiting, a.heard, a.wake, a.posted) == (1, 2, 1, 160.0, 400.0, 1)
    assert (a.gap, a.std, a.status, a.version, a.receipt) == (0.2, 0.02, "ok", 3, "applied")
    assert store.servo("nobody") is None


def test_a_window_with_its_body(store: Store) -> None:
    store.put([window(body=b"packed")._replace(encoding="zstd")])
    found = store.window("a", "boot", 1)
    assert (found.kind, found.body, found.encoding, found.received) == (Kind.WINDOW, b"packed", "zstd", 100.0)
    assert store.window("a", "boot", 2) is store.window("b", "boot", 1) is None
    store.put([window(sequence=2), window(sequence=3)])
    assert [held.sequence for held in store.windows("a", limit=2)] == [3, 2]
    assert [held.sequence for held in store.windows("a", before=store.windows("a")[1].id)] == [1]


def process(store: Store, *found: Evidence, servo: str = "a") -> None:
    """Claim and commit, with this evidence of the claim's first message."""
    (lent,) = claim(store, servo=servo)
    mine = [one._replace(message=one.message or lent.messages[0].id) for one in found]
    assert store.commit([outcome(lent, *mine)], 201.0) == [True]


def test_the_evidence_chain(store: Store) -> None:
    store.put([window(sequence=1)])
    process(
        store, Evidence("estimate", 0, b"e1", version=0, gap=0.1, status="ok", tail=9e-4), Evidence("trend", 0, b"")
    )
    store.put([window(sequence=2)])
    seen = Evidence("estimate", 0, b"e2", version=0, gap=0.2, std=0.01, status="ok", tail=8e-4)
    process(store, Evidence("glance", 0, b"g2", version=0), seen, Evidence("update", 0, b"u", version=1))
    store.put([letter(body=b"receipt")])
    process(store, Evidence("receipt", 0, b"r", version=1, status="applied"))
    store.put([window("b", 1)])
    process(store, Evidence("glance", 0, b"", version=1, tail=0.5), servo="b")
    store.put([window(sequence=3)])
    process(store, Evidence("glance", 0, b"g3", version=1, gap=0.2, status="calm", tail=1e-5))
    store.put([window(sequence=4)])
    process(store, Evidence("glance", 0, b"g4", version=1, tail=2e-5))

    links = store.audit("a")
    assert [link.window.sequence for link in links] == [4, 3, 2, 1]
    assert [len(link.steps) for link in links] == [0, 0, 1, 0]
    acted = links[2]
    assert [one.kind for one in acted.found] == ["glance", "estimate"]
    (step,) = acted.steps
    assert (step.update.kind, step.update.version, step.update.body) == ("update", 1, b"u")
    assert [(one.kind, one.status) for one in step.answers] == [("receipt", "applied")]
    assert (step.effect.window.sequence, step.effect.window.start) == (3, 6.0)
    assert (step.effect.before.tail, step.effect.after.tail, step.effect.after.body) == (8e-4, 1e-5, b"g3")
    assert store.audit("a", window=("boot", 2)) == [acted]
    assert [link.window.sequence for link in store.audit("a", limit=1)] == [4]
    assert [link.window.sequence for link in store.audit("a", before=acted.window.id)] == [1]
    assert store.audit("a", since=100.5) == store.audit("nobody") == []


def test_a_window_that_is_not_yet_processed_is_in_the_chain(store: Store) -> None:
    store.put([window(), window("b")])
    (link,) = store.audit("a")
    assert (link.window.sequence, link.window.done, link.found, link.steps) == (1, None, (), ())


def test_an_update_after_a_proof_hangs_on_its_window(store: Store) -> None:
    store.put([window()])
    (lent,) = claim(store)
    store.commit([outcome(lent, Evidence("estimate", lent.messages[0].id, b""), enqueue=(proof(),))], 201.0)
    (asked,) = claim(store, kinds=(Kind.PROOF,))
    late = Evidence("update", asked.messages[0].id, b"", version=1, window="boot/1")
    store.commit([outcome(asked, late)], 202.0)
    (link,) = store.audit("a")
    assert [step.update.version for step in link.steps] == [1]
    assert link.steps[0].effect is None


def test_the_chain_is_one_query(store: Store) -> None:
    store.put([window(sequence=sequence) for sequence in range(20)])
    asked: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        asked.append(statement)

    sa.event.listen(store.engines.reader, "before_cursor_execute", note)
    assert len(store.audit("a")) == 20
    sa.event.remove(store.engines.reader, "before_cursor_execute", note)
    assert len([statement for statement in asked if not statement.startswith("BEGIN")]) == 1


def test_many_threads_with_the_same_windows_keep_each_once(store: Store) -> None:
    became: list[list[Put]] = []
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


def test_claims_of_many_threads_do_not_overlap(store: Store) -> None:
    names = [f"s{n}" for n in range(40)]
    store.put([window(name) for name in names])
    lent: list[str] = []

    def borrow(owner: str) -> None:
        while found := claim(store, owner, limit=3):
            lent.extend(one.servo for one in found)

    threads = [threading.Thread(target=borrow, args=(f"owner {n}",)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # A row that another thread holds is passed over: what is left then is for the next one who asks.
    lent.extend(one.servo for one in claim(store, "last", limit=40))
    assert sorted(lent) == sorted(names)


def test_a_message_that_comes_while_its_servo_is_lent_is_not_forgotten(store: Store) -> None:
    store.put([window()])
    (lent,) = claim(store)
    store.put([window(sequence=2)])
    store.commit([outcome(lent)], 201.0)
    (again,) = claim(store)
    assert (again.serial, len(again.messages)) == (1, 1)


def test_no_message_is_forgotten_when_outcomes_and_messages_come_at_once(store: Store) -> None:
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
        found = claim(store, per_servo=4)
        assert store.commit([outcome(one) for one in found], 201.0) == [True] * len(found)
        taken += sum(len(one.messages) for one in found)
        idle = idle + 1 if finished and not found else 0
    sender.join()
    assert taken == total


def test_opened_again_everything_is_there(new_address: NewAddress) -> None:
    address = new_address()
    store = open_store(address)
    store.put([window()])
    store.close()
    store = open_store(address)
    assert bodies_of(claim(store)[0]) == [b"samples"]
    store.close()


@pytest.mark.parametrize("url", ["mysql://u:secret@h/d", "postgresql://u:secret@h:port/d", "http://secret@h/d", ""])
def test_an_address_that_is_none_is_refused_without_what_it_hides(url: str) -> None:
    with pytest.raises(InvalidInput, match=r"the store's address") as refused:
        open_store(url)
    assert "secret" not in str(refused.value)
