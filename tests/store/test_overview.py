"""Queries of the dashboard."""

import pytest
from store_cases import claim, letter, outcome, window

from servotwin.store import overview
from servotwin.store.overview import StorePosition
from servotwin.store.records import EvidenceRecord
from servotwin.store.store import open_store


@pytest.fixture
def store(tmp_path):
    """Servos a and b with two windows each, a's worked on."""
    opened = open_store(f"sqlite:///{tmp_path}/twin.db")
    opened.put([window(servo, number, received=100.0 + number) for servo in "ab" for number in (1, 2)])
    (lease,) = claim(opened, servo="a")
    first, second = (message.id for message in lease.messages)
    opened.commit(
        [
            outcome(
                lease,
                EvidenceRecord("estimate", first, b"one", 0, 0.1, 0.01, "ok"),
                EvidenceRecord("trend", first, b"old", gap=0.1),
                EvidenceRecord("update", first, b"", 1, window="boot/1"),
                EvidenceRecord("glance", second, b"two", 1, 0.2, 0.01, "nothing moved"),
                EvidenceRecord("trend", second, b"new", gap=0.2),
                EvidenceRecord("receipt", 0, b"", 1, status="applied"),
                EvidenceRecord("alarm", second, b"", status="loose"),
            )
        ],
        300.0,
    )
    yield opened
    opened.close()


def facts(store, names, since=0.0):
    return {each.summary.servo: each for each in store.reading(lambda c: overview.facts(c, names, since))}


def test_facts_are_the_newest_of_each_servo(store):
    found = facts(store, ["a", "b", "nobody"])
    assert list(found) == ["a", "b"]
    newest = found["a"].newest
    assert {kind: record.body for kind, record in newest.items()} == {"trend": b"new", "window": b"two", "receipt": b""}
    assert (found["a"].window.sequence, found["a"].summary.gap) == (2, 0.2)
    assert [alarm.status for alarm in found["a"].alarms] == ["loose"]
    assert (found["b"].newest, found["b"].alarms, found["b"].window.sequence) == ({}, (), 2)


def test_old_alarms_are_left_out(store):
    assert facts(store, ["a"], since=301.0)["a"].alarms == ()


def test_changes_are_those_after_a_position(store):
    position = store.reading(overview.position)
    since = lambda at: sorted(store.reading(lambda c: overview.changed(c, at, 10)))  # noqa: E731
    assert since(position) == []
    assert since(StorePosition(0, 0)) == ["a", "b"]
    store.put([letter("b", b"new")])
    assert since(position) == ["b"]
    assert store.reading(overview.position).message > position.message


def test_gaps_come_oldest_first_with_their_evidence(store):
    found = store.reading(lambda c: overview.gaps(c, "a", 10))
    assert [each.window.sequence for each in found] == [1, 2]
    assert [[record.kind for record in each.evidence] for each in found] == [["estimate", "trend"], ["glance", "trend"]]
    newest = store.reading(lambda c: overview.gaps(c, "a", 1, bodies=False))
    assert [record.body for record in newest[0].evidence] == [b"", b""]
    before = store.reading(lambda c: overview.gaps(c, "a", 10, before=found[1].window.id))
    assert [each.window.sequence for each in before] == [1]


def test_decisions_are_in_order(store):
    assert [one.kind for one in store.reading(lambda c: overview.decisions(c, "a", 5))] == ["update", "receipt"]


def test_the_audit_of_updates_leaves_the_other_windows_out(store):
    assert [trace.window.sequence for trace in store.audit("a")] == [2, 1]
    assert [trace.window.sequence for trace in store.audit("a", updates=True)] == [1]
