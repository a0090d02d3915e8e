"""What a worker does: equal claims, equal outcomes; what fails is evidence and stalls nobody."""

import hashlib
import math
import os
import subprocess
import sys
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from exploration import examples
from few_machines import certified_scenario
from hypothesis import given
from hypothesis import strategies as st
from leases import SCENARIO, claim, fleet, kinds, loop, receipt, statuses, windows

from servotwin import messages
from servotwin.control.gains import gains_of
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.estimation.learning.wear import TrendState
from servotwin.messages import (
    Acknowledge,
    Hello,
    LetterAcknowledge,
    Setting,
    Update,
    decode,
    encode,
)
from servotwin.messages.acts import Act, ActKind, encode_act
from servotwin.messages.codec import DEFLATE, ZSTD, compress
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.store.records import Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin import step as stepping
from servotwin.twin.estimating import DecodedWindow
from servotwin.twin.evidence_rows import MAX_STATUS, plain
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.work import ABANDON_AFTER, ONE_BY_ONE, work


@pytest.mark.slow
def test_a_window_becomes_evidence_and_an_update():
    outcome = work(fleet(), claim(windows()[1], serial=4), 100.0)
    assert (outcome.servo, outcome.serial, outcome.done, outcome.wake) == ("axis", 4, (1,), 105.0)
    assert kinds(outcome, 1) == ["estimate", "disturbance", "trend", "machine", "motor", "redesign", "update"]
    (sent,) = map(decode, outcome.outgoing)
    assert isinstance(sent, Update)
    assert (sent.version, sent.base_version) == (windows()[1].parameter_version + 1, windows()[1].parameter_version)
    assert sent.window == (windows()[1].boot, windows()[1].sequence)
    update = outcome.evidence[-1]
    assert (decode(update.body), update.version, update.gap) == (sent, sent.version, sent.gap)
    estimate = outcome.evidence[0]
    assert (estimate.status, estimate.gap, estimate.std) == ("ok", sent.gap, sent.std)
    assert {row.context for row in outcome.evidence} == {key for key, _ in outcome.contexts}
    assert not any(isinstance(message, Acknowledge) for message in map(decode, outcome.outgoing))


def test_bodies_keep_every_bit_of_what_the_twin_of_the_simulation_found():
    sent = [m.message for m in loop().messages if m.direction == "up"]
    outcome = work(fleet(), claim(*sent), 0.0)
    estimates = [msgspec.msgpack.decode(row.body)["estimate"] for row in outcome.evidence if row.kind == "estimate"]
    assert [plain(each) for each in estimates] == [plain(each) for each in loop().estimates]
    trends = [row.body for row in outcome.evidence if row.kind == "trend"]
    assert trends == [plain(TrendState.of(trend)) for trend in loop().trends if trend is not None]
    disturbances = [row.body for row in outcome.evidence if row.kind == "disturbance"]
    assert disturbances == [plain(each) for each in loop().disturbances]
    updates = [decode(row.body) for row in outcome.evidence if row.kind == "update"]
    assert updates == list(loop().updates)


def test_infinities_and_nan_are_kept():
    values = {"a": math.inf, "b": -math.inf, "c": np.float64(0.1), "d": np.array([math.nan, -0.0])}
    found = msgspec.msgpack.decode(plain(values))
    assert (found["a"], found["b"], found["c"]) == (math.inf, -math.inf, 0.1)
    assert math.isnan(found["d"][0])
    assert math.copysign(1.0, found["d"][1]) == -1.0


@pytest.mark.slow
def test_equal_claims_give_equal_outcomes():
    sent = claim(*windows(), b"rubbish")
    assert work(fleet(), sent, 7.0) == work(fleet(), sent, 7.0)


@pytest.mark.slow
def test_and_in_another_process():
    """Where strings hash otherwise; the context may be another, as sources may be edited meanwhile."""
    sent = msgspec.msgpack.encode([encode(window) for window in windows()[:2]])
    paths = os.pathsep.join((str(Path(__file__).parent), *filter(None, sys.path)))
    elsewhere = subprocess.run(
        [sys.executable, "-c", "import sys, test_work as t; print(t.said(sys.stdin.buffer.read()))"],
        env={**os.environ, "PYTHONHASHSEED": "2", "PYTHONPATH": paths},
        input=sent,
        capture_output=True,
        check=True,
        timeout=300,
    )
    assert elsewhere.stdout.decode().strip() == said(sent)


def said(sent: bytes) -> str:
    """Digest of all that is said of some windows."""
    outcome = work(fleet(), claim(*msgspec.msgpack.decode(sent)), 7.0)
    parts = outcome.state, outcome.outgoing, [row._replace(context="") for row in outcome.evidence]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 2])
def test_how_messages_are_split_into_claims_does_not_matter(size):
    sent = [m.message for m in loop().messages if m.direction == "up"]
    whole, state, rows, out = work(fleet(), claim(*sent), 0.0), b"", [], []
    for first in range(0, len(sent), size):
        part = sent[first : first + size]
        outcome = work(fleet(), claim(*part, state=state, received=[float(first + k) for k in range(len(part))]), 0.0)
        state, out = outcome.state, out + list(outcome.outgoing)
        rows += [(row.kind, row.body) for row in outcome.evidence]
    assert state == whole.state
    assert out == list(whole.outgoing)
    assert rows == [(row.kind, row.body) for row in whole.evidence]


@pytest.mark.parametrize("encoding", [DEFLATE, ZSTD])
def test_bodies_come_as_they_were_sent(encoding):
    plainly = work(fleet(), claim(windows()[1]), 0.0)
    assert work(fleet(), claim((compress(encode(windows()[1]), encoding), encoding)), 0.0) == plainly


@cache
def zeros(encoding: str) -> bytes:
    """A bomb: it becomes much longer than it is."""
    return compress(bytes(40_000_000), encoding)


SPOILT = {
    "no message": (b"\xc1", "InvalidMessage"),
    "nothing": (b"", "InvalidMessage"),
    "wrong encoding": ((encode(Hello("axis", "b", 0.0, 1.0, 0, Setting(0.0), "m")), DEFLATE), "InvalidMessage"),
    "unknown encoding": ((b"x", "br"), "InvalidMessage"),
    "a bomb": ((zeros, DEFLATE), "InvalidMessage"),
    "a bomb of zstd": ((zeros, ZSTD), "InvalidMessage"),
    "cut short": ((zlib.compress(b"x" * 1000)[:-3], DEFLATE), "InvalidMessage"),
    "an edge's": (encode(Acknowledge("axis", "b", 1)), "InvalidMessage"),
    "another servo's": (encode(Hello("other", "b", 0.0, 1.0, 0, Setting(0.0), "m")), "InvalidMessage"),
}


@cache
def worked_without() -> WorkResult:
    return work(fleet(), claim(windows()[0], windows()[1]), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPOILT)
def test_what_cannot_be_used_is_evidence_and_the_rest_goes_on(kind):
    spoilt, error_name = SPOILT[kind]
    if kind.startswith("a bomb"):
        spoilt = zeros(spoilt[1]), spoilt[1]
    outcome = work(fleet(), claim(windows()[0], spoilt, windows()[1]), 0.0)
    assert outcome.done == (1, 2, 3)
    assert statuses(outcome)[1].startswith(f"failed: {error_name}: ")
    assert kinds(outcome, 2) == ["estimate"]
    without = worked_without()
    assert (outcome.outgoing, statuses(outcome)[::2]) == (without.outgoing, statuses(without))


@given(st.binary(max_size=300), st.sampled_from(["", DEFLATE, ZSTD, "gzip"]))
@examples(200)
def test_no_bytes_make_it_fail(body, encoding):
    outcome = work(fleet(), claim((body, encoding)), 0.0)
    assert outcome.done == (1,)
    assert statuses(outcome)[0].startswith("failed: ")


@pytest.mark.slow
def test_a_twin_that_breaks_midway_is_as_if_the_window_had_not_been_there(monkeypatch):
    good, right = stepping.draft_update, work(fleet(), claim(windows()[0], windows()[2]), 0.0)

    def breaks(message, *others):
        if message.sequence == windows()[1].sequence:
            raise ZeroDivisionError("float division by zero\0" + 1000 * "!")
        return good(message, *others)

    monkeypatch.setattr(stepping, "draft_update", breaks)
    outcome = work(fleet(), claim(*windows()[:3], received=[0.0, 0.5, 1.0]), 0.0)
    assert kinds(outcome, 2) == ["estimate"]
    status = statuses(outcome)[1]
    assert status.startswith("failed: ZeroDivisionError: float division by zero!!!")
    assert len(status) == MAX_STATUS
    assert (outcome.state, outcome.outgoing) == (right.state, right.outgoing)


def test_an_overdue_update_is_sent_again_then_abandoned():
    first = work(fleet(), claim(windows()[1]), 100.0)
    state, sent = first.state, first.outgoing
    for now, expected, wake in ((104.9, (), 105.0), (105.0, sent, 110.0), (110.0, sent, 115.0), (115.0, (), None)):
        outcome = work(fleet(), claim(state=state), now)
        assert (outcome.outgoing, outcome.wake, outcome.done, outcome.evidence) == (expected, wake, (), ())
        state = outcome.state


def test_an_answer_in_the_same_lease_is_processed_before_anything_is_sent_again():
    first = work(fleet(), claim(windows()[1]), 100.0)
    update = decode(first.outgoing[0])
    outcome = work(fleet(), claim(receipt(update), state=first.state), 200.0)
    assert (outcome.outgoing, outcome.wake) == ((), None)
    (row,) = outcome.evidence
    assert (row.kind, row.version, row.status, decode(row.body)) == (
        "receipt",
        update.version,
        "applied",
        receipt(update),
    )


def test_a_clock_that_is_put_back_holds_nothing_up():
    asks = fleet(excitation=ExcitationSettings())
    first = work(asks, claim(windows()[1]), 1e6)
    back = work(asks, claim(state=first.state), 50.0)
    assert (back.outgoing, back.wake) == ((), 55.0)
    assert work(asks, claim(state=back.state), 55.0).outgoing == first.outgoing


def test_a_servo_is_woken_within_a_minute_although_nothing_is_due_before_an_hour():
    """Of a wake-up that is further ahead the store thinks that it was set under another clock."""
    first = work(fleet(retry=3600.0), claim(windows()[1]), 50.0)
    again = work(fleet(retry=3600.0), claim(state=first.state), 110.0)
    assert first.wake == 110.0
    assert (again.outgoing, again.wake) == ((), 170.0)


def test_a_clock_that_is_put_forward_sends_again_once():
    first = work(fleet(), claim(windows()[1]), 50.0)
    after = work(fleet(), claim(state=first.state), 1e9)
    assert (after.outgoing, after.wake) == (first.outgoing, 1e9 + 5.0)


def test_a_backlog_sends_nothing_twice():
    """Messages that came long ago are sent about now."""
    outcome = work(fleet(), claim(*windows(), received=[0.0] * len(windows())), 1e6)
    assert len(set(outcome.outgoing)) == len(outcome.outgoing)
    assert outcome.wake == 1e6 + 5.0


@pytest.mark.slow
def test_what_passed_between_two_boots_is_taken_from_when_windows_came():
    """Not from when they were processed: a backlog of an hour is an hour."""
    reborn = msgspec.structs.replace(windows()[2], boot="boot-2")
    one = work(fleet(), claim(windows()[1], reborn, received=[0.0, 3600.0]), 3600.0)
    split = work(fleet(), claim(windows()[1], received=[0.0]), 0.0)
    two = work(fleet(), claim(reborn, state=split.state, received=[3600.0]), 3600.0)
    trends = [[row.body for row in outcome.evidence if row.kind == "trend"][-1] for outcome in (one, two)]
    assert trends[0] == trends[1]
    at_once = work(fleet(), claim(windows()[1], reborn, received=[0.0, 0.0]), 3600.0)
    assert [row.body for row in at_once.evidence if row.kind == "trend"][-1] != trends[0]


def test_a_hello_says_what_a_restarted_edge_runs():
    law = SCENARIO.start_law.replace(Kp=1000.0)
    gains = messages.Gains(law.Kp, law.Ki, law.Kd, law.Tf)
    hello = Hello("axis", "boot-9", 0.0, 5000.0, 7, Setting(1e-5, gains), "m")
    outcome = work(fleet(), claim(hello), 0.0)
    (row,) = outcome.evidence
    assert (row.kind, row.version, row.status, decode(row.body)) == ("hello", 7, "boot-9", hello)
    known = msgspec.msgpack.decode(outcome.state)["known"]
    assert known[7] == {"tolerance": 1e-5, "gains": msgspec.to_builtins(gains)}
    then = work(fleet(), claim(msgspec.structs.replace(windows()[1], boot="boot-9"), state=outcome.state), 0.0)
    assert (decode(then.outgoing[0]).version, decode(then.outgoing[0]).base_version) == (8, 7)


def test_a_state_that_cannot_be_read_is_stored_and_the_twin_begins_anew():
    version = msgspec.structs.replace(windows()[1], parameter_version=40)
    outcome = work(fleet(), claim(version, state=b"\x81\xa4typeonce"), 0.0)
    (first, *rest) = outcome.evidence
    assert (first.message, first.kind) == (0, "estimate")
    assert first.status.startswith("failed: the state of servo 'axis' is not understood")
    assert msgspec.msgpack.decode(first.body)["state"] == b"\x81\xa4typeonce"
    assert [row.status.partition(":")[0] for row in rest[:2]] == ["released by servotwin", "ask no more by servotwin"]
    assert [row.kind for row in rest[2:]] == [
        *("estimate", "disturbance", "trend", "machine", "motor", "redesign", "update"),
    ]
    assert decode(outcome.outgoing[0]).version == 41


def test_a_hold_outlives_the_other_parts_of_a_state_that_cannot_be_read():
    hold = Act("axis", ActKind.HOLD, "eva", "the bearing is replaced", 5.0)
    sent = StoredMessage(2, MessageKind.ACT, encode_act(hold), "", 0.0)
    held = work(fleet(), claim()._replace(messages=(sent,)), 0.0)
    document = msgspec.msgpack.decode(held.state)
    outcome = work(fleet(), claim(windows()[1], state=msgspec.msgpack.encode(document | {"wear": 7})), 0.0)
    assert statuses(outcome)[0].startswith("failed: the state of servo 'axis' is not understood")
    assert "act" not in [row.kind for row in outcome.evidence]
    assert outcome.outgoing == ()
    assert msgspec.msgpack.decode(outcome.state)["oversight"]["held"] == hold.sentence
    of_another = msgspec.msgpack.encode(document | {"servo": "another"})
    assert work(fleet(), claim(windows()[1], state=of_another), 0.0).outgoing


def test_a_servo_without_a_model_fails_without_a_word_to_it():
    lost = replace(fleet(), servos=(("other", "m"),))
    outcome = work(lost, claim(windows()[0], state=b"kept", serial=3), 0.0)
    assert (outcome.state, outcome.serial, outcome.done, outcome.wake) == (b"kept", 3, (1,), None)
    assert statuses(outcome) == [
        "failed: servo 'axis' has no model: [servos] has neither its name nor a pattern that fits"
    ]


def test_a_twin_that_is_switched_off_leaves_windows_as_they_are():
    outcome = work(fleet(enabled=False), claim(*windows()), 0.0)
    assert (outcome.evidence, outcome.outgoing, outcome.contexts) == ((), (), ())
    assert outcome.done == tuple(range(1, len(windows()) + 1))
    approval = Act("axis", ActKind.APPROVE, "eva", "looks right", 5.0, window=("boot-1", 1))
    sent = StoredMessage(1, MessageKind.ACT, encode_act(approval), "", 0.0)
    (row,) = work(fleet(enabled=False), claim()._replace(messages=(sent,)), 0.0).evidence
    assert row.status.endswith("(refused: the twin of this servo is switched off)")


def test_what_kills_its_workers_is_found_and_abandoned():
    sent = windows()[:2]
    assert work(fleet(), claim(*sent, attempts=ONE_BY_ONE - 1), 0.0).done == (1, 2)
    alone = work(fleet(), claim(*sent, attempts=ONE_BY_ONE), 0.0)
    assert (alone.done, statuses(alone)) == ((1,), ["ok"])
    abandoned = work(fleet(), claim(*sent, attempts=ABANDON_AFTER), 0.0)
    assert (abandoned.done, statuses(abandoned)) == (
        (1,),
        [f"failed: abandoned, because {ABANDON_AFTER - 1} workers died while they processed it"],
    )
    pending = work(fleet(), claim(windows()[1]), 0.0)
    kept = work(fleet(), claim(windows()[2], state=pending.state, attempts=ABANDON_AFTER), 1.0)
    assert (kept.state, kept.wake) == (pending.state, 5.0)
    quiet = work(fleet(), claim(state=pending.state, attempts=ABANDON_AFTER), 100.0)
    assert (quiet.state, quiet.wake, quiet.outgoing) == (pending.state, None, ())


def test_the_tail_is_the_largest_error_in_the_last_tenth():
    window = windows()[1]
    run = loop().run
    first = round(window.start * window.rate)
    part = slice(first + window.samples - window.samples // 10, first + window.samples)
    expected = np.abs(run.reference[part] - run.measured("position")[part]).max()
    assert DecodedWindow.of(window).tail == pytest.approx(expected, abs=2.0 * window.channel("position").scale)
    outcome = work(fleet(), claim(window), 0.0)
    assert [row.tail for row in outcome.evidence if row.kind == "estimate"] == [DecodedWindow.of(window).tail]
    alone = msgspec.structs.replace(window, channels=window.channels[1:])
    assert DecodedWindow.of(alone).tail is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["certified", "calm"])
def test_it_says_what_the_twin_of_the_simulation_says(name):
    """Every message of a scenario in the order and at the times in which it came."""
    scenario = certified_scenario(25.0) if name == "certified" else Scenario.preset(name).replace(duration=25.0)
    lived = cosimulate(scenario)
    start = Setting(scenario.start_tolerance, gains_of(scenario.start_law))
    mine = ModelRegistry((ServoModel("m", scenario.model, scenario.twin, start),), (("*", "m"),))
    state, sent = b"", []
    for each in (m for m in lived.messages if m.direction == "up"):
        stored = StoredMessage(1, MessageKind.LETTER, each.data, "", each.arrival)
        outcome = work(mine, Lease(scenario.name, state, 0, (stored,)), each.arrival)
        state, sent = outcome.state, sent + list(outcome.outgoing)
    down = [m for m in lived.messages if m.direction == "down"]
    assert sent == [m.data for m in down if not isinstance(m.message, Acknowledge | LetterAcknowledge)]
    assert len(sent) >= 1
    assert TwinSettings() != scenario.twin or name == "calm"
