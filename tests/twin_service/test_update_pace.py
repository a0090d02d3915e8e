"""The time that an update takes until its edge has decided, with invented clocks."""

import random
from collections import Counter

import pytest

from servotwin.messages import Setting, Update, encode
from servotwin.store.records import EvidenceRecord, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.update_pace import UpdatePace

VALIDITY = 8.0
KNOWN = ("b0", 0), 20.0, 0.1, 0.01, (0.08, 0.12), "OK", Setting(1e-4)


class Bench:
    """A pace whose clock stands until it is moved."""

    def __init__(self) -> None:
        self.now = 1e4
        self.pace = UpdatePace(lambda servo: servo[0], Clocks(lambda: self.now, lambda: self.now))
        self.version = 0
        for servo in ("a1", "b1"):
            self.turn(60.0, servo)

    def turn(self, seconds, servo="a1", status="", sent=True, validity=VALIDITY):
        """Work on a window; `status`: why it led to no setting."""
        self.now += seconds
        self.version += 1
        update = encode(Update(servo, self.version, 0, *KNOWN, 20.0 + validity))
        row = EvidenceRecord("redesign", 1, b"", status=status)
        lease = Lease(servo, b"", 0, (StoredMessage(1, MessageKind.WINDOW, b"", "", self.now),))
        outgoing = (update,) if sent and not status else ()
        result = WorkResult(servo, 0, b"", None, (1,), (row,), outgoing)
        self.pace.note_work(result, seconds)
        self.pace.note_ways(lease, result)

    def receipt(self, way, servo="a1", version=None):
        """Process the receipt for the last update, which came after so long and waited for a while."""
        lease = Lease(servo, b"", 0, (StoredMessage(2, MessageKind.LETTER, b"", "", self.now + way),))
        self.now += way + 3.0
        row = EvidenceRecord("receipt", 2, b"", version=version or self.version, status="expired")
        result = WorkResult(servo, 0, b"", None, (2,), (row,))
        self.pace.note_work(result, 0.001)
        self.pace.note_ways(lease, result)

    @property
    def expected(self):
        return self.pace.expected("a9")


def test_the_first_updates_are_tried_because_the_very_first_may_compile():
    assert Bench().expected == 0.0


def test_turns_without_an_update_do_not_shorten_what_one_is_expected_to_take():
    bench = Bench()
    bench.turn(7.0)
    for _ in range(50):
        bench.turn(0.2, status="too late by 1 s")
        bench.turn(0.5, status="the verified setting is in force already")
        bench.turn(0.1, sent=False)
    assert bench.expected == 7.0


def test_the_longest_times_are_expected_but_not_a_single_one_of_many():
    bench = Bench()
    for seconds in (1.0, 5.0, 1.0):
        bench.turn(seconds)
    assert bench.expected == 5.0
    bench.turn(1.0)
    assert bench.expected == 1.0
    bench.turn(4.0)
    assert bench.expected == 4.0
    for _ in range(16):
        bench.turn(0.5)
    assert bench.expected == 0.5


def test_models_are_counted_apart():
    bench = Bench()
    bench.turn(7.0)
    bench.turn(0.2, servo="b1")
    assert (bench.expected, bench.pace.expected("b2"), bench.pace.expected("c1")) == (7.0, 0.2, 0.0)


@pytest.mark.parametrize(("seconds", "doubted_s"), [(7.0, 80.0), (100.0, 100.0)])
def test_half_is_expected_after_ten_validities_without_an_update_and_what_comes_then_replaces_the_old(
    seconds, doubted_s
):
    bench = Bench()
    for _ in range(5):
        bench.turn(seconds)
    bench.now += doubted_s - 1.0
    assert bench.expected == seconds
    bench.now += 1.0
    assert bench.expected == seconds / 2.0
    bench.now += doubted_s
    assert bench.expected == seconds / 4.0
    bench.turn(1.0)
    assert bench.expected == 1.0
    bench.now += 1e9
    assert bench.expected < 1e-9


def test_the_usual_time_from_an_update_to_its_receipt_counts_and_not_how_long_that_waits_for_a_turn():
    bench = Bench()
    for way in (0.2, 0.6, 5.0):
        bench.turn(2.0)
        bench.receipt(way)
    assert bench.expected == pytest.approx(2.6)


def test_an_edge_that_was_away_and_a_receipt_for_something_else_tell_nothing_of_the_way():
    bench = Bench()
    bench.turn(2.0)
    bench.receipt(0.5, version=77)
    bench.receipt(0.5, servo="a2")
    bench.receipt(VALIDITY + 1.0)
    bench.receipt(0.5)
    assert bench.expected == pytest.approx(2.0)


def overload(work, minutes=30.0, servos=5, length=2.0):
    """Outcomes of updates: one worker, servos in turns, each window a second old at most when its turn begins."""
    bench, chance, outcomes = Bench(), random.Random(7), Counter()
    end = bench.now + 60.0 * minutes
    while bench.now < end:
        for n in range(servos):
            age, takes = length + chance.random(), work(chance, bench.now - end + 60.0 * minutes)
            if age + bench.pace.expected(f"a{n}") >= VALIDITY:
                outcomes["not begun"] += 1
                bench.turn(0.3, f"a{n}", status="too late")
                continue
            bench.turn(takes, f"a{n}")
            outcomes["expired" if age + takes + 0.6 > VALIDITY else "applied"] += 1
            bench.receipt(0.6, f"a{n}")
    return outcomes


def test_where_work_takes_too_long_few_updates_expire():
    outcomes = overload(lambda chance, _at: chance.uniform(5.0, 9.0))
    # Half an hour has 22 times ten validities.
    assert outcomes["expired"] <= 25
    assert outcomes["not begun"] > 1000


def test_when_the_machine_becomes_fast_updates_come_again_within_ten_validities():
    outcomes = overload(lambda _chance, at: 7.0 if at < 600.0 else 2.0, minutes=20.0)
    assert outcomes["expired"] <= 9
    assert outcomes["applied"] > 80


def test_where_work_is_quick_enough_nothing_is_left_out():
    outcomes = overload(lambda chance, _at: chance.uniform(2.0, 4.0))
    assert (outcomes["expired"], outcomes["not begun"]) == (0, 0)
