"""Series of one machine from its stored windows."""

import math

import msgspec

from servotwin.dashboard.series import GAP_COLUMNS, fallbacks, gap_series, versions
from servotwin.store.overview import WindowGap
from servotwin.store.records import StoredEvidence, StoredWindow


def evidence(kind, body=None, status="", gap=None, version=None, created=0.0):
    packed = msgspec.msgpack.encode(body)
    return StoredEvidence(1, kind, 0, packed, version, gap, 0.01, status, "", None, created)


def test_a_window_has_its_estimate_its_trend_and_the_decision():
    body = {"estimate": {"interval": [0.1, math.inf], "rms": 2e-6, "reasons": ["too calm"]}}
    records = (
        evidence("glance", status="moved", gap=0.2),
        evidence("estimate", body, "lower bound", 0.1, 3),
        evidence("trend", gap=0.15),
        evidence("redesign", status="the estimate is lower bound"),
    )
    first = StoredWindow(1, "a", "b", 7, 2.0, 100.0, None)
    series = gap_series([WindowGap(first, records), WindowGap(first._replace(sequence=8), ())])
    assert tuple(series) == GAP_COLUMNS
    assert series["sequence"] == [7, 8]
    assert (series["gap"], series["low"], series["high"]) == ([0.1, None], [0.1, None], [None, None])
    assert (series["trend"], series["residual"]) == ([0.15, None], [2e-6, None])
    assert (series["reasons"], series["decision"]) == ([["too calm"], []], ["the estimate is lower bound", ""])


def test_a_failure_has_no_numbers():
    record = evidence("estimate", {"failed": "no"}, "failed: no")
    series = gap_series([WindowGap(StoredWindow(1, "a", "b", 7, 2.0, 100.0, None), (record,))])
    assert (series["gap"], series["low"], series["status"]) == ([None], [None], ["failed: no"])


def test_versions_have_the_edge_s_answer():
    decided = [
        evidence("update", version=1, gap=0.1, created=1.0),
        evidence("receipt", {"applied": True}, "applied", version=1, created=2.0),
        evidence("update", version=2, gap=0.2, created=3.0),
        evidence("receipt", {"applied": False}, "expired", version=2, created=4.0),
        evidence("update", version=3, gap=0.3, created=5.0),
        evidence("fallback", status="limit cycle", version=1, created=6.0),
    ]
    assert [(row["version"], row["applied"], row["answered"], row["reason"]) for row in versions(decided)] == [
        (1, True, 2.0, "applied"),
        (2, False, 4.0, "expired"),
        (3, None, None, ""),
    ]
    assert fallbacks(decided) == [{"time": 6.0, "cause": "limit cycle", "version": 1}]
