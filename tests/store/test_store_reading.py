"""Queries of the store: outgoing messages, summaries, windows, and the evidence chain in one query."""

import pytest
import sqlalchemy as sa
from store_cases import NewAddress, bodies_of, claim, letter, outcome, verification, window

from servotwin.messages import Reason
from servotwin.store.records import Backlog, EvidenceRecord, MessageKind, OutgoingMessage
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)


@pytest.mark.slow
def test_serials_of_outgoing_messages_rise_per_servo(store: Store) -> None:
    for sequence in (1, 2):
        store.put([window(sequence=sequence), window("b", sequence)])
        store.commit([outcome(one, outgoing=(b"x%d" % sequence, b"y%d" % sequence)) for one in claim(store)], 201.0)
    assert store.outgoing("a", 0) == [
        OutgoingMessage(1, b"x1"),
        OutgoingMessage(2, b"y1"),
        OutgoingMessage(3, b"x2"),
        OutgoingMessage(4, b"y2"),
    ]
    assert store.outgoing("b", 2) == [OutgoingMessage(3, b"x2"), OutgoingMessage(4, b"y2")]
    assert store.outgoing("a", 0, limit=1) == [OutgoingMessage(1, b"x1")]
    assert store.outgoing("a", 4) == store.outgoing("nobody", 0) == []


def test_the_backlog_counts_messages_and_gives_the_age_of_the_oldest(store: Store) -> None:
    assert store.backlog(200.0) == Backlog(0, 0, 0.0)
    store.put([window(received=110.0), letter(received=120.0), window("b", received=150.0)])
    assert store.backlog(200.0) == Backlog(3, 0, 90.0, 90.0)
    store.commit([outcome(claim(store, servo="a")[0])], 201.0)
    assert store.backlog(200.0) == Backlog(1, 0, 50.0, 50.0)


def test_contexts_are_kept_once(store: Store) -> None:
    store.put([window(), window("b")])
    known = (("k1", '{"numpy": "2"}'),)
    made = [outcome(one, EvidenceRecord("estimate", 0, b"", context="k1"), contexts=known) for one in claim(store)]
    assert store.commit(made, 201.0) == [True, True]
    assert store.contexts(["k1", "k2"]) == {"k1": '{"numpy": "2"}'}


def test_the_summary_of_a_servo(store: Store) -> None:
    store.put([window(), letter(received=150.0), window("b")])
    result = (
        EvidenceRecord("glance", 0, b"", gap=0.1, std=0.01, status="calm"),
        EvidenceRecord("estimate", 0, b"", gap=0.2, std=0.02, status="ok"),
        EvidenceRecord("update", 0, b"", version=3, gap=0.2),
        EvidenceRecord("receipt", 0, b"", version=3, status="applied"),
    )
    store.commit([outcome(claim(store, servo="a")[0], *result, outgoing=(b"u",), wake=400.0)], 201.0)
    store.put([window(sequence=2, received=160.0)])
    assert [one.servo for one in store.servos()] == ["a", "b"]
    assert [one.servo for one in store.servos(after="a")] == ["b"]
    a = store.servo("a")
    assert (a.serial, a.windows, a.waiting, a.last_message, a.wake, a.posted) == (1, 2, 1, 160.0, 400.0, 1)
    assert (a.gap, a.std, a.status, a.version, a.receipt) == (0.2, 0.02, "ok", 3, "applied")
    assert store.servo("nobody") is None


def test_the_last_message_is_the_one_that_came_last_though_the_clock_was_set_back(store):
    store.put([window(sequence=0, received=1e6)])
    store.put([window(sequence=1, received=200.0), letter(received=201.0)])
    assert store.servo("a").last_message == 201.0
    store.put([verification(received=300.0)])
    assert store.servo("a").last_message == 201.0, "a verification is the twin's own"


def test_a_window_with_its_body(store: Store) -> None:
    store.put([window(body=b"packed")._replace(encoding="zstd")])
    result = store.window("a", "boot", 1)
    assert (result.kind, result.body, result.encoding, result.received) == (
        MessageKind.WINDOW,
        b"packed",
        "zstd",
        100.0,
    )
    assert store.window("a", "boot", 2) is store.window("b", "boot", 1) is None
    store.put([window(sequence=2), window(sequence=3)])
    assert [held.sequence for held in store.windows("a", limit=2)] == [3, 2]
    assert [held.sequence for held in store.windows("a", before=store.windows("a")[1].id)] == [1]


def process(store: Store, *result: EvidenceRecord, servo: str = "a") -> None:
    """Claim and commit, with this evidence of the claim's first message."""
    (lease,) = claim(store, servo=servo)
    mine = [one._replace(message=one.message or lease.messages[0].id) for one in result]
    assert store.commit([outcome(lease, *mine)], 201.0) == [True]


def test_the_evidence_chain(store: Store) -> None:
    store.put([window(sequence=1)])
    process(
        store,
        EvidenceRecord("estimate", 0, b"e1", version=0, gap=0.1, status="ok", tail=9e-4),
        EvidenceRecord("trend", 0, b""),
    )
    store.put([window(sequence=2)])
    estimate = EvidenceRecord("estimate", 0, b"e2", version=0, gap=0.2, std=0.01, status="ok", tail=8e-4)
    process(
        store, EvidenceRecord("glance", 0, b"g2", version=0), estimate, EvidenceRecord("update", 0, b"u", version=1)
    )
    store.put([letter(body=b"receipt")])
    process(store, EvidenceRecord("receipt", 0, b"r", version=1, status="applied"))
    store.put([window("b", 1)])
    process(store, EvidenceRecord("glance", 0, b"", version=1, tail=0.5), servo="b")
    store.put([window(sequence=3)])
    process(store, EvidenceRecord("glance", 0, b"g3", version=1, gap=0.2, status="calm", tail=1e-5))
    store.put([window(sequence=4)])
    process(store, EvidenceRecord("glance", 0, b"g4", version=1, tail=2e-5))

    links = store.audit("a")
    assert [link.window.sequence for link in links] == [4, 3, 2, 1]
    assert [len(link.steps) for link in links] == [0, 0, 1, 0]
    acted = links[2]
    assert [one.kind for one in acted.evidence] == ["glance", "estimate"]
    (step,) = acted.steps
    assert (step.update.kind, step.update.version, step.update.body) == ("update", 1, b"u")
    assert [(one.kind, one.status) for one in step.answers] == [("receipt", "applied")]
    assert (step.effect.window.sequence, step.effect.window.start) == (3, 6.0)
    assert (step.effect.before.tail, step.effect.after.tail, step.effect.after.body) == (8e-4, 1e-5, b"g3")
    assert store.audit("a", window=("boot", 2)) == [acted]
    assert [link.window.sequence for link in store.audit("a", limit=1)] == [4]
    assert [link.window.sequence for link in store.audit("a", before=acted.window.id)] == [1]
    assert store.audit("a", since=100.5) == store.audit("nobody") == []


def test_a_refused_update_has_no_effect_although_a_fallback_took_its_number(store: Store) -> None:
    store.put([window(sequence=1)])
    estimate = EvidenceRecord("estimate", 0, b"e1", version=0, gap=0.2, std=0.01, status="ok", tail=8e-4)
    process(store, estimate, EvidenceRecord("update", 0, b"u", version=1))
    store.put([letter(body=b"receipt")])
    process(store, EvidenceRecord("receipt", 0, b"r", version=1, status=Reason.OLD_VERSION.value))
    store.put([window(sequence=2)])
    process(store, EvidenceRecord("glance", 0, b"g2", version=1, gap=0.2, status="calm", tail=1e-3))
    (step,) = store.audit("a")[1].steps
    assert (step.answers[0].status, step.effect) == ("version not newer than the one in force", None)


def test_a_window_that_is_not_yet_processed_is_in_the_chain(store: Store) -> None:
    store.put([window(), window("b")])
    (link,) = store.audit("a")
    assert (link.window.sequence, link.window.done, link.evidence, link.steps) == (1, None, (), ())


def test_an_update_after_a_verification_belongs_to_its_window(store: Store) -> None:
    store.put([window()])
    (lease,) = claim(store)
    store.commit(
        [outcome(lease, EvidenceRecord("estimate", lease.messages[0].id, b""), enqueue=(verification(),))], 201.0
    )
    (asked,) = claim(store, kinds=(MessageKind.VERIFICATION,))
    late = EvidenceRecord("update", asked.messages[0].id, b"", version=1, window="boot/1")
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


def test_opened_again_everything_is_there(new_address: NewAddress) -> None:
    address = new_address()
    store = open_store(address)
    store.put([window()])
    store.close()
    store = open_store(address)
    assert bodies_of(claim(store)[0]) == [b"samples"]
    store.close()


@pytest.mark.slow
def test_events_that_belong_to_no_window(store: Store) -> None:
    """Starts, fallbacks, answers, and what the twin itself could not do; newest first, of one servo."""
    store.put([letter(), window(), letter("b")])
    first, second = claim(store, servo="a")[0], claim(store, servo="b")[0]
    word, cut = first.messages[0].id, first.messages[1].id
    result = (
        EvidenceRecord("hello", word, b"h", version=0, status="boot"),
        EvidenceRecord("receipt", word, b"r", version=1, status="applied"),
        EvidenceRecord("estimate", cut, b"e", status="ok"),
        EvidenceRecord("fallback", word, b"f", version=1, status="limit cycle"),
        EvidenceRecord("estimate", 0, b"s", status="failed: no state"),
    )
    assert (
        store.commit([outcome(first, *result), outcome(second, EvidenceRecord("hello", 0, b"other"))], 201.0)
        == [True] * 2
    )
    assert [(one.kind, one.status, one.created) for one in store.events("a")] == [
        ("estimate", "failed: no state", 201.0), ("fallback", "limit cycle", 201.0), ("hello", "boot", 201.0)
    ]  # fmt: skip
    assert [one.kind for one in store.events("a", limit=1)] == ["estimate"]
    assert store.events("a", since=202.0) == store.events("nobody") == []
    assert [one.received for one in store.events("a")] == [None, first.messages[0].received, first.messages[0].received]


@pytest.mark.slow
def test_events_after_the_clock_was_set_back_are_later_ones(store: Store) -> None:
    """They follow in the order of the store."""
    store.put([letter()])
    first = claim(store, servo="a")[0]
    word = first.messages[0].id
    assert store.commit([outcome(first, EvidenceRecord("fallback", word, b"f", version=1))], 5e6) == [True]
    store.put([letter(body=b"later")])
    second = claim(store, servo="a")[0]
    word = second.messages[0].id
    assert store.commit([outcome(second, EvidenceRecord("hello", word, b"h", version=2))], 300.0) == [True]
    assert [one.kind for one in store.events("a", since=4e6)] == ["hello", "fallback"]
