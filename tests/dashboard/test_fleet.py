"""Rows of the fleet from facts of the store."""

import math

import msgspec
import pytest

from servotwin.dashboard.evidence_body import NORMAL_95, WearRate, interval_of, wear_rate
from servotwin.dashboard.fleet import fleet_row, time_until_limit, version_in_force
from servotwin.dashboard.machine_facts import UNKNOWN, machine_facts
from servotwin.store.overview import ServoFacts
from servotwin.store.records import ServoSummary, StoredEvidence

NOTHING = ServoSummary("a", 0, 0, 0, None, None, None, None, "", None, "", 0)


def evidence(id_, kind, body=None, version=None, status="", gap=None, std=None, context="", created=0.0):
    packed = msgspec.msgpack.encode(body)
    return StoredEvidence(id_, kind, 0, packed, version, gap, std, status, context, None, created)


def test_the_time_until_the_limit_is_what_is_left_over_the_rate():
    exact = WearRate(0.0, 0.1, 0.0, 0.01, 0.0)
    assert time_until_limit(exact, 0.3) == (pytest.approx(20.0), (pytest.approx(20.0), pytest.approx(20.0)))
    assert time_until_limit(exact, 0.1)[0] == 0.0
    assert time_until_limit(exact, None) == (None, None)
    assert time_until_limit(None, 0.3) == (None, None)


def test_a_rate_that_may_be_zero_may_never_reach_the_limit():
    middle, (early, late) = time_until_limit(WearRate(0.0, 0.1, 0.01, 0.01, 0.01), 0.3)
    assert middle == pytest.approx(20.0)
    assert early == pytest.approx((0.2 - NORMAL_95 * 0.01) / (0.01 + NORMAL_95 * 0.01))
    assert late is None
    assert time_until_limit(WearRate(0.0, 0.1, 0.0, -0.01, 0.001), 0.3) == (None, None)


def test_the_version_in_force_is_what_the_edge_reported_in_its_present_boot():
    window = evidence(5, "estimate", version=3)
    receipt = evidence(7, "receipt", {"parameter_version": 4, "boot": "b"}, 5)
    hello = evidence(9, "hello", version=2, status="c")
    assert version_in_force({}) is None
    assert version_in_force({"window": window}) == 3
    assert version_in_force({"window": window, "receipt": receipt}) == 4  # version 5 was refused
    assert version_in_force({"window": window, "receipt": receipt, "hello": hello}, "b") == 2  # started again
    late = window._replace(id=11)  # a window that was cut before the receipt and came after it
    assert version_in_force({"window": late, "receipt": receipt}, "b") == 4
    assert version_in_force({"window": late, "receipt": receipt, "hello": hello}, "c") == 3


def test_a_machine_without_data_has_a_row_of_unknowns():
    row = fleet_row(ServoFacts(NOTHING, None, {}), {}, None)
    assert (row.gap, row.interval, row.rate, row.until_limit, row.version_in_force, row.alarms) == (None,) * 5 + ((),)


def test_a_lower_bound_has_no_upper_end():
    summary = NOTHING._replace(gap=0.1, std=0.01, status="lower bound")
    low, high = fleet_row(ServoFacts(summary, None, {}), {}, True).interval
    assert low == pytest.approx(0.1 - NORMAL_95 * 0.01)
    assert high is None


def test_an_alarm_is_shown_once_at_its_newest_time():
    alarms = tuple(
        evidence(id_, "alarm", status=text, created=float(id_)) for id_, text in ((3, "x"), (2, "y"), (1, "x"))
    )
    shown = fleet_row(ServoFacts(NOTHING, None, {}, alarms), {}, True).alarms
    assert [(alarm.time, alarm.sentence) for alarm in shown] == [(3.0, "x"), (2.0, "y")]


@pytest.mark.parametrize(
    ("boot", "version", "runs"),
    [("b", 0, True), ("c", 4, True), ("c", 0, False)],
    ids=["same boot", "stored", "started anew"],
)
def test_an_edge_that_runs_its_fallback_set_has_an_alarm_as_long_as_it_does(boot, version, runs):
    fallback = evidence(7, "fallback", {"parameter_version": 4, "boot": "b"}, 3, "limit cycle", created=70.0)
    hello = evidence(9 if boot == "c" else 5, "hello", version=version, status=boot)
    row = fleet_row(ServoFacts(NOTHING, None, {"fallback": fallback, "hello": hello}), {}, True)
    expected = [(70.0, "the edge runs its fallback set: limit cycle")] if runs else []
    assert [(alarm.time, alarm.sentence) for alarm in row.alarms] == expected
    applied = evidence(11, "receipt", {"parameter_version": 5, "boot": boot}, 5)
    newest = {"fallback": fallback, "hello": hello, "receipt": applied}
    assert not fleet_row(ServoFacts(NOTHING, None, newest), {}, True).alarms


def test_one_window_alone_tells_no_wear():
    body = {"time": 0.0, "mean": [0.1, 0.0, 0.0], "covariance": [1e-6, 0, 0, 0, 1e3, 0, 0, 0, 0]}
    assert wear_rate(evidence(1, "trend", {**body, "updates": 1})) is None
    assert wear_rate(evidence(1, "trend", {**body, "updates": 2})).rate == 0.0


def test_limit_and_travel_come_from_the_context():
    parts = {"settings.gap_limit": "0.35", "settings.policy": "'paper'", "model.p": "3e-4"}
    newest = {"trend": evidence(1, "trend", {"time": 0, "mean": [0.1, 0.01, 0], "covariance": [0] * 9}, context="k")}
    row = fleet_row(ServoFacts(NOTHING, None, newest), {"k": msgspec.json.encode(parts).decode()}, True)
    assert (row.gap_limit, row.travel, row.travel_unit, row.command_unit) == (0.35, 3e-4, "m", "V")
    assert row.until_limit == pytest.approx(25.0)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"settings.gap_limit": "__import__(1)"}', '{"model.axis": "\'[\'"}'])
def test_a_context_that_cannot_be_read_tells_nothing(text):
    assert machine_facts(text) == UNKNOWN


def test_an_axis_tells_its_units():
    file = '[actuator]\nkind = "torque"\n[load]\nkind = "rotary"\n[transmission]\nkind = "gear"\nratio = 4.0\n'
    facts = machine_facts(msgspec.json.encode({"model.axis": repr(file)}).decode())
    assert (facts.travel, facts.travel_unit, facts.command_unit) == (0.25, "rad", "N m")


@pytest.mark.parametrize("body", [None, 3, {}, {"mean": [], "covariance": []}, {"time": 0, "mean": ["x"] * 3}])
def test_a_trend_that_cannot_be_read_is_unknown(body):
    assert wear_rate(evidence(1, "trend", body)) is None


def test_an_interval_without_an_end_is_unbounded():
    body = {"estimate": {"interval": [0.1, math.inf]}}
    assert interval_of(evidence(1, "estimate", body)) == (0.1, None)
    assert interval_of(evidence(1, "glance", gap=0.0, std=1.0)) == (0.0, NORMAL_95)
