"""Queries of the dashboard."""

import msgspec
import pytest
from store_cases import claim, letter, outcome, window

from servotwin.dashboard.series import machine_series
from servotwin.store import overview
from servotwin.store.overview import StorePosition
from servotwin.store.records import EvidenceRecord

pytest_plugins = ("store_fixtures",)


@pytest.fixture
def filled(store):
    """Servos a and b with two windows each, a's worked on."""
    store.put([window(servo, number, received=100.0 + number) for servo in "ab" for number in (1, 2)])
    (lease,) = claim(store, servo="a")
    first, second = (message.id for message in lease.messages)
    store.commit(
        [
            outcome(
                lease,
                EvidenceRecord("estimate", first, b"one", 0, 0.1, 0.01, "ok"),
                EvidenceRecord("trend", first, b"old", gap=0.1),
                EvidenceRecord("update", first, b"", 1, window="boot/1"),
                EvidenceRecord("glance", second, b"two", 1, 0.2, 0.01, "nothing moved"),
                EvidenceRecord("trend", second, b"new", gap=0.2),
                EvidenceRecord("redesign", second, b"large", status="nothing to gain"),
                EvidenceRecord("receipt", 0, b"", 1, status="applied"),
                EvidenceRecord("alarm", second, b"", status="loose"),
            )
        ],
        300.0,
    )
    return store


def facts(store, names, since=0.0):
    return {each.summary.servo: each for each in store.reading(lambda c: overview.facts(c, names, since))}


def test_facts_are_the_newest_of_each_servo(filled):
    found = facts(filled, ["a", "b", "nobody"])
    assert list(found) == ["a", "b"]
    newest = found["a"].newest
    assert {kind: record.body for kind, record in newest.items()} == {"trend": b"new", "window": b"two", "receipt": b""}
    assert (found["a"].window.sequence, found["a"].summary.gap) == (2, 0.2)
    assert [alarm.status for alarm in found["a"].alarms] == ["loose"]
    assert (found["b"].newest, found["b"].alarms, found["b"].window.sequence) == ({}, (), 2)


def test_the_newest_window_is_that_of_the_present_boot_with_the_highest_number(store):
    def cut(boot, sequence):
        return window("a", sequence)._replace(boot=boot, key=f"{boot}/{sequence}")

    late_first = [cut("new", number) for number in (3, 2, 1)]
    store.put([cut("old", 7), letter("a", b"hello"), *late_first, cut("old", 8)])
    (lease,) = claim(store, servo="a")
    number = next(message.id for message in lease.messages if message.body == b"hello")
    store.commit([outcome(lease, EvidenceRecord("hello", number, b"", 0, status="new"))], 300.0)
    newest = facts(store, ["a"])["a"].window
    assert (newest.boot, newest.sequence) == ("new", 3)


def test_old_alarms_are_left_out(filled):
    assert facts(filled, ["a"], since=301.0)["a"].alarms == ()


def test_a_noisy_servo_s_alarms_hide_no_other_s(filled):
    (lease,) = claim(filled, servo="b")
    many = [EvidenceRecord("alarm", lease.messages[0].id, b"", status=f"loud {number}") for number in range(1100)]
    filled.commit([outcome(lease, *many)], 400.0)
    found = facts(filled, ["a", "b"])
    assert [alarm.status for alarm in found["a"].alarms] == ["loose"]
    assert found["b"].alarms[0].status == "loud 1099"


def test_changes_are_those_after_a_position(filled):
    position = filled.reading(overview.position)
    since = lambda at: sorted(filled.reading(lambda c: overview.changed(c, at, 10)))  # noqa: E731
    assert since(position) == []
    assert since(StorePosition(0, 0)) == ["a", "b"]
    filled.put([letter("b", b"new")])
    assert since(position) == ["b"]
    assert filled.reading(overview.position).message > position.message


def test_gaps_come_oldest_first_with_their_evidence(filled):
    found = filled.reading(lambda c: overview.gaps(c, "a", 10))
    assert [each.window.sequence for each in found] == [1, 2]
    assert [[record.kind for record in each.evidence] for each in found] == [
        ["estimate", "trend"],
        ["glance", "trend", "redesign"],
    ]
    assert found[1].evidence[-1].body == b""
    newest = filled.reading(lambda c: overview.gaps(c, "a", 1, bodies=False))
    assert [record.body for record in newest[0].evidence] == [b"", b"", b""]
    before = filled.reading(lambda c: overview.gaps(c, "a", 10, before=found[1].window.id))
    assert [each.window.sequence for each in before] == [1]


def test_the_machine_is_known_while_its_newest_window_waits(store):
    """`servotwin audit` showed a rotary machine that is behind in um and V."""
    axis = '[actuator]\nkind = "torque"\n[load]\nkind = "rotary"\n[transmission]\nratio = 2.0\n'
    context = msgspec.json.encode({"model.axis": repr(axis)}).decode()
    store.put([window("a", 1)])
    (lease,) = claim(store, servo="a")
    found = EvidenceRecord("estimate", lease.messages[0].id, b"", 0, 0.1, 0.01, "ok", context="here")
    store.commit([outcome(lease, found, contexts=(("here", context),))], 300.0)
    store.put([window("a", 2)])
    machine = store.reading(lambda connection: machine_series(connection, "a", 1))["machine"]
    assert (machine.travel_unit, machine.command_unit, machine.travel) == ("rad", "N m", 0.5)


def test_decisions_are_in_order(filled):
    assert [one.kind for one in filled.reading(lambda c: overview.decisions(c, "a", 5))] == ["update", "receipt"]


def test_the_audit_of_updates_leaves_the_other_windows_out(filled):
    assert [trace.window.sequence for trace in filled.audit("a")] == [2, 1]
    assert [trace.window.sequence for trace in filled.audit("a", updates=True)] == [1]
