"""A stored estimate made again: bit for bit, or what is not as it was then."""

import json
import math
import os
import pickle
import subprocess
import sys
from functools import cache

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.control.gains import gains_of
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.messages import Acknowledge, Setting, checksum, encode
from servotwin.plant.servo import Servo
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.store.records import Lease, MessageKind, StoredMessage
from servotwin.twin import context as contexts
from servotwin.twin.context import context_of, described, differences, parts_of
from servotwin.twin.evidence_rows import plain
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.replay import replay
from servotwin.twin.settings import TwinSettings
from servotwin.twin.work import work

NAMES = ("fig15", "fig16", "calm")


@cache
def estimated(name: str) -> tuple[list[tuple[bytes, bytes, str]], ServoModel]:
    """(window, evidence, context) of each estimate that a scenario led to."""
    scenario = Scenario.preset(name).replace(duration=65.0)
    model = ServoModel(
        "m", scenario.model, scenario.twin, Setting(scenario.start_tolerance, gains_of(scenario.start_law))
    )
    fleet, state, found = ModelRegistry((model,), (("*", "m"),)), b"", []
    for each in (m for m in cosimulate(scenario).messages if m.direction == "up"):
        stored = StoredMessage(1, MessageKind.WINDOW, each.data, "", each.arrival)
        outcome = work(fleet, Lease(scenario.name, state, 0, (stored,)), each.arrival)
        rows = [row for row in outcome.evidence if row.kind == "estimate"]
        found += [(each.data, row.body, dict(outcome.contexts)[row.context]) for row in rows]
        state = outcome.state
    return found, model


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("given_model", [False, True])
def test_every_stored_estimate_comes_out_again(name, given_model):
    found, model = estimated(name)
    assert len(found) >= 3
    for window, body, context in found:
        again = replay(window, body, context, model if given_model else None)
        assert (again.same, again.differs, again.changed) == (True, (), ())


@pytest.mark.slow
@pytest.mark.exploration
def test_in_another_process_too():
    """The suite has a claim that is worked on in other processes, in test_work.py."""
    script = (
        "import sys, pickle; from servotwin.twin.replay import replay\n"
        "cases = pickle.load(sys.stdin.buffer)\n"
        "print([replay(*case).same for case in cases])"
    )
    cases = [case for name in NAMES for case in estimated(name)[0][-2:]]
    done = subprocess.run(
        [sys.executable, "-c", script],
        input=pickle.dumps(cases),
        env={**os.environ, "PYTHONHASHSEED": "3", "PYTHONPATH": "."},
        capture_output=True,
        check=True,
        timeout=300,
    )
    assert done.stdout.decode().strip() == repr([True] * len(cases))


def test_the_prior_counts():
    """It is what was stored that is used, not what this twin would expect."""
    window, body, context = estimated("fig15")[0][-1]
    other = msgspec.msgpack.decode(body)
    other["prior"]["previous"] = 0.3
    again = replay(window, msgspec.msgpack.encode(other), context)
    assert (again.same, again.differs) == (False, ())
    assert "evaluations" in again.changed


@pytest.mark.slow
def test_another_model_is_named_with_both_values():
    window, body, context = estimated("calm")[0][-1]
    model = estimated("calm")[1]
    stiffer = ServoModel("m", model.servo.replace(k=11e3), model.settings, model.start)
    again = replay(window, body, context, stiffer)
    assert (again.same, again.differs) == (False, ("model.k 10000.0 then, 11000.0 now",))
    assert {"gap", "model_version"} <= set(again.changed)


@pytest.mark.slow
def test_a_setting_that_does_not_matter_is_named_all_the_same():
    window, body, context = estimated("calm")[0][-1]
    model = estimated("calm")[1]
    other = ServoModel("m", model.servo, model.settings.replace(validity=61.0), model.start)
    assert replay(window, body, context, other)[1:] == (True, ("settings.validity None then, 61.0 now",), ())


@pytest.mark.parametrize("part", ["numpy", "scipy", "numba", "python", "servotwin", "source estimation", "processor"])
def test_another_version_is_named(part):
    window, body, context = estimated("fig15")[0][0]
    then = {**parts_of(context), part: "0.0.1"}
    (named,) = replay(window, body, json.dumps(then)).differs
    assert named == f"{part} 0.0.1 then, {parts_of(context)[part]} now"


def test_a_part_that_one_side_does_not_know_is_named():
    assert differences({"a": "1", "b": "2"}, {"b": "2", "c": "3"}) == ("a 1 then, unknown now", "c unknown then, 3 now")


def test_an_edited_source_shows(tmp_path, monkeypatch):
    package = tmp_path / "identify"
    package.mkdir()
    (package / "gap.py").write_text("a = 1\n")
    monkeypatch.setattr(contexts.servotwin, "__file__", str(tmp_path / "__init__.py"))
    before = contexts._source("identify")
    assert before == contexts._source("identify")
    (package / "gap.py").write_text("a = 2\n")
    assert before != contexts._source("identify")


def test_a_window_that_no_estimator_took_is_the_same_again():
    window = cosimulate(Scenario.preset("fig15").replace(duration=3.0)).windows[0]
    channels = tuple(channel for channel in window.channels if channel.name != "position")
    blind = msgspec.structs.replace(window, channels=channels, crc=checksum(channels))
    model = estimated("fig15")[1]
    fleet = ModelRegistry((model,), (("*", "m"),))
    outcome = work(
        fleet, Lease(window.servo, b"", 0, (StoredMessage(1, MessageKind.WINDOW, encode(blind), "", 0.0),)), 0.0
    )
    row = next(row for row in outcome.evidence if row.kind == "estimate")
    again = replay(encode(blind), row.body, dict(outcome.contexts)[row.context])
    assert (again.same, again.differs) == (True, ())
    assert "'position' is missing" in again.estimate.reasons[0]


@pytest.mark.parametrize(
    ("servo", "settings"),
    [
        (Servo.preset("paper"), TwinSettings()),
        (Servo.preset("table1").replace(m=(1.0, 2.0, 3.0), voltage_limit=24.0), TwinSettings(k_dz=2, policy="paper")),
        (
            Servo.preset("paper").replace(k_d=1e6),
            TwinSettings(
                estimator=whitened.WhitenedSettings(offset=(0.1, 0.2)), excitation=ExcitationSettings(), gap_limit=0.3
            ),
        ),
        (Servo.preset("paper"), Scenario.preset("fig16").twin),
    ],
)
def test_model_and_settings_come_back_from_the_context(servo, settings):
    found = described(parts_of(context_of(servo, settings)[1]))
    assert found == (servo, settings)
    assert context_of(*found)[0] == context_of(servo, settings)[0] or settings.k_dz == 2


def test_equal_contexts_have_one_key_and_others_another():
    servo, settings = Servo.preset("paper"), TwinSettings()
    key, text = context_of(servo, settings)
    assert context_of(Servo.preset("paper"), TwinSettings()) == (key, text)
    others = {context_of(servo.replace(k=9e3), settings)[0], context_of(servo, settings.replace(retry=6.0))[0]}
    assert len({key} | others) == 3
    assert parts_of(text)["settings.demands.tail"] == repr(math.inf)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_what_is_not_understood_is_reported(which):
    good = list(estimated("fig15")[0][0])
    for bad in [b"", b"\xc1", encode(Acknowledge("a", "b", 1)), plain({"failed": "x"})] if which < 2 else ["", "[]"]:
        with pytest.raises(InvalidInput, match=r"not understood|can be estimated"):
            replay(*good[:which], bad, *good[which + 1 :])


@pytest.mark.parametrize(
    "change",
    [
        {"model.k": "'stiff'"},
        {"model.k.x": "1"},
        {"model.k": "__import__('os')"},
        {"model.k": "-1.0"},
        {"settings.method": "'none'"},
    ],
)
def test_a_context_that_describes_no_model_is_refused(change):
    window, body, context = estimated("fig15")[0][0]
    with pytest.raises(InvalidInput, match=r"not understood|does not exist"):
        replay(window, body, json.dumps({**parts_of(context), **change}))


@pytest.mark.slow
@given(st.dictionaries(st.text(max_size=20), st.text(max_size=20), max_size=4))
def test_no_context_makes_it_fail_otherwise(parts):
    with pytest.raises(InvalidInput):
        described({**{f"model.{key}": value for key, value in parts.items()}, **parts})
