"""A twin that is bytes between any two calls is the same twin, bit for bit."""

import math
import struct
from dataclasses import astuple
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from exploration import examples
from few_machines import certified_scenario
from hypothesis import given
from hypothesis import strategies as st
from stage_scenario import stage
from twin_messages import make, window_message

from servotwin.control.gains import gains_of
from servotwin.cosim import Cosimulation, Loop, SimulatedMachine
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.edge.probe import ProbeLimits
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus, interval_95
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.learning.wear import TrendState
from servotwin.messages import (
    Cause,
    Fallback,
    Gains,
    Hello,
    Reason,
    Receipt,
    Setting,
    Update,
    decode,
)
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.lookups import LookupState
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TriageSettings, TwinSettings
from servotwin.twin.state import MAX_ENDED_BOOTS, MAX_SETTINGS, Versions, decode_state, encode_state
from servotwin.twin.twin import Twin

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")


class Reborn:
    """A twin that dies after every call; what is left of it is its state."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.store, self.state, self.deaths = scenario, EvidenceLog(), b"", 0

    def twin(self) -> Twin:
        s = self.scenario
        start = Setting(s.start_tolerance, gains_of(s.start_law))
        return Twin(s.name, TwinModel.of(s.model, s.twin, start), self.store, self.state)

    def receive(self, message, now):
        return self._leaving(self.twin(), lambda twin: twin.receive(message, now))

    def wake(self, now):
        return self._leaving(self.twin(), lambda twin: twin.wake(now))

    def next_wake(self):
        return self.twin().next_wake()

    def _leaving(self, twin, act):
        sent = act(twin)
        self.state, self.deaths = twin.state(), self.deaths + 1
        return sent


def run(scenario: Scenario, remote: Reborn | None = None) -> Loop:
    machine = SimulatedMachine(scenario)
    loop = Cosimulation(scenario, machine, twin=remote)
    if remote is not None:
        loop.store = remote.store
    while not loop.done:
        loop.advance()
    return loop.loop(machine.run())


def probed() -> Scenario:
    """Steps within the gap, one way: the twin asks for longer windows, then for a probing move."""
    calm = Scenario.preset("calm")
    excitation = ExcitationSettings(probe=2e-4, interval=30.0)
    twin = calm.twin.replace(excitation=excitation, uncertainty=calm.twin.uncertainty.replace(gap=(0.0, 25.0 * DEG)))
    recording = Recording(probe=ProbeLimits(2e-4, 20.0))
    reference = Samples([0.0, 10.0, 20.0, 30.0], [4e-5, 8e-5, 1.2e-4, 1.6e-4])
    return calm.replace(gap=10.0 * DEG, twin=twin, recording=recording, reference=reference, duration=35.0)


SCENARIOS = {
    "fig15": lambda: Scenario.preset("fig15").replace(duration=45.0),
    "certified": lambda: certified_scenario(45.0),
    "probed": probed,
    "taught": lambda: stage((20261126, 2), duration=20.0).scenario,
}


@cache
def both(name: str) -> tuple[Loop, Loop, Reborn]:
    scenario = SCENARIOS[name]()
    remote = Reborn(scenario)
    return run(scenario), run(scenario, remote), remote


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_twin_that_dies_after_every_message_says_the_same(name):
    living, reborn, remote = both(name)
    assert living.digest() == reborn.digest()
    assert remote.deaths >= 4
    assert living.updates == reborn.updates
    assert living.requests == reborn.requests
    assert name not in ("probed", "taught") or living.requests


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_and_finds_the_same(name):
    living, reborn, _ = both(name)
    assert len(living.estimates) >= 2
    for part in ("estimates", "disturbances", "excitations"):
        of_living, of_reborn = (repr([astuple(one) for one in getattr(loop, part)]) for loop in (living, reborn))
        assert of_living == of_reborn
    states = [
        [trend and msgspec.msgpack.encode(TrendState.of(trend)) for trend in loop.trends] for loop in both(name)[:2]
    ]
    assert states[0] == states[1]
    for one, other in zip(living.redesigns, reborn.redesigns, strict=True):
        assert (one.setting, one.reason) == (other.setting, other.reason)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_the_state_is_its_own_fixed_point(name):
    _, _, remote = both(name)
    assert remote.twin().state() == remote.state
    assert 200 < len(remote.state) < 10_000


FLOATS = st.floats(width=64)
MATRIX = st.lists(FLOATS, min_size=9, max_size=9)


@st.composite
def trends(draw, depth: int = 2) -> Trend:
    return Trend(
        draw(FLOATS),
        np.array(draw(st.lists(FLOATS, min_size=3, max_size=3))),
        np.array(draw(MATRIX)).reshape(3, 3),
        TrendSettings(),
        draw(st.integers(0, 2**40)),
        draw(st.integers(0, 2**40)),
        tuple(draw(st.lists(st.text(), max_size=2))),
        draw(trends(depth - 1)) if depth and draw(st.booleans()) else None,
    )


def bits(trend: Trend | None):
    if trend is None:
        return None
    arrays = trend.mean.tobytes(), trend.covariance.tobytes()
    return struct.pack("<d", trend.time), *arrays, trend.updates, trend.refused, trend.reasons, bits(trend.rival)


@given(trends())
def test_a_trend_keeps_every_bit(trend):
    """NaN, infinities and the sign of zero too, in the rival of its rival as well."""
    carried = msgspec.msgpack.decode(msgspec.msgpack.encode(TrendState.of(trend)), type=TrendState)
    assert bits(carried.trend(TrendSettings())) == bits(trend)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 12),
            st.sampled_from(["boot-1", "boot-2", "boot-3"]),
            st.floats(0.0, 1e4),
            st.integers(0, 20),
            st.sampled_from(["window", "hello", "receipt", "fallback", "wake"]),
        ),
        max_size=15,
    )
)
@examples(60)
def test_whatever_comes_a_restored_twin_goes_on_the_same(events):
    """Boots that come back, old windows, receipts for nothing, a clock that jumps."""
    lives, dies = make()[0], make()[0]
    for number, boot, now, version, kind in events:
        message = {
            "window": window_message(number, 3.0 * number, boot, version=version),
            "hello": Hello("axis", boot, 0.0, 100.0, version, Setting(1e-5, Gains(1.0, 2.0, 3.0, 0.1)), "m"),
            "receipt": Receipt("axis", version, True, 3, Reason.APPLIED, version, boot),
            "fallback": Fallback("axis", boot, 5, Cause.ERROR, 1.0, 0.5, version, version + 1, Setting(2e-5)),
        }.get(kind)
        replies = [twin.wake(now) if message is None else twin.receive(message, now) for twin in (lives, dies)]
        assert replies[0] == replies[1]
        state = dies.state()
        assert state == lives.state()
        fresh = Twin("axis", dies.model, dies.log, state)
        assert fresh.state() == state
        assert fresh.next_wake() == lives.next_wake()
        dies = fresh


@given(st.binary(max_size=200))
def test_bytes_that_are_no_state_are_refused(data):
    with pytest.raises(InvalidInput, match="the state of servo 'axis' is not understood"):
        make()[0].restore(data)


@given(st.data())
def test_a_broken_state_is_refused_or_restored_never_anything_else(data):
    twin = make()[0]
    twin.receive(window_message(3, 20.0), 21.0)
    state = bytearray(twin.state())
    state[data.draw(st.integers(0, len(state) - 1))] = data.draw(st.integers(0, 255))
    del state[data.draw(st.integers(0, len(state))) :]
    fresh = make()[0]
    try:
        fresh.restore(bytes(state))
    except InvalidInput:
        assert fresh.state() == make()[0].state()


def test_a_later_schema_and_another_servos_state_are_refused():
    twin = make()[0]
    later = twin.state().replace(b"twin-state/2", b"twin-state/3")
    with pytest.raises(InvalidInput, match="not understood"):
        twin.restore(later)
    other = Twin("other", twin.model)
    with pytest.raises(InvalidInput, match=r"the state of servo 'other' belongs to 'axis'"):
        other.restore(twin.state())


OLD = msgspec.msgpack.decode((Path(__file__).parents[1] / "data" / "twin_state_v1.msgpack").read_bytes())
"""A state of the version before, made by it, and what its twin then sent for two windows and two wake-ups."""


def old_twin(state: bytes, *gaps: float) -> Twin:
    gaps = list(gaps)

    def estimate(window, _expected):
        gap = gaps.pop(0)
        return GapEstimate(gap, 1e-4, 1e-3, interval_95(gap, 1e-3), GapStatus.OK, window.mid_time, method="test")

    excitation = ExcitationSettings(probe=1e-2, interval=15.0)
    settings = TwinSettings(policy="paper", excitation=excitation, triage=TriageSettings(), retry=2.0, attempts=3)
    return Twin("axis", TwinModel.of(SERVO, settings, estimator=estimate), state=state)


def test_a_state_of_the_version_before_goes_on_where_that_one_was():
    twin = old_twin(OLD["state"], *OLD["gaps"])
    sent = [twin.receive(decode(window), now) for window, now in zip(OLD["windows"], OLD["arrivals"], strict=True)] + [
        twin.wake(now) for now in OLD["wakes"]
    ]
    assert sent == [[decode(message) for message in messages] for messages in OLD["sent"]]
    assert any(isinstance(message, Update) for message in sent[0])
    assert twin.next_wake() == OLD["next_wake"]


def test_a_state_of_the_version_before_keeps_all_that_it_knew():
    state, late = (decode_state("axis", OLD[name]) for name in ("state", "late"))
    raw = msgspec.msgpack.decode(OLD["state"])
    assert state.lookups == LookupState("version 3 failed", misled=True)
    assert state.known[0] == Setting(1e-4, gains_of(SERVO.controller))
    assert state.known[3] == Setting(2e-4, Gains(1.0, 2.0, 3.0, 0.1, 0.5, 1.5, -0.01))
    assert state.known[6] == Setting(3e-4, Gains(9.0, 0.0, 3.0, 0.1))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(state.wear.state)) == raw["wear"]["trend"]
    assert state.wear.state.rival is not None
    assert state.requests.pending is not None
    assert state.triage.vain == 3
    assert isinstance(late.versions.pending, Update)
    assert repr(decode_state("axis", encode_state(state))) == repr(state)


def test_settings_are_no_part_of_it():
    twin = make(retry=5.0, initial_gap=0.5)[0]
    twin.receive(window_message(0, 10.0), 11.0)
    other = make(retry=9.0, initial_gap=0.1)[0]
    other.restore(twin.state())
    assert (twin.next_wake(), other.next_wake()) == (16.0, 20.0)


def test_requests_come_and_go_with_the_settings():
    asking = TwinSettings(policy="paper", excitation=ExcitationSettings())
    quiet = asking.replace(excitation=None)
    one, other = (Twin("axis", TwinModel.of(SERVO, each)) for each in (asking, quiet))
    with_requests, without = one.state(), other.state()
    other.restore(with_requests)
    assert other.state() == without
    one.restore(without)
    assert one.state() == with_requests


def test_what_is_remembered_is_bounded():
    """Ten thousand updates that nobody answers, and as many boots."""
    twin, _ = make()
    size = 0
    for k in range(300):
        twin.receive(window_message(k, 1.0 + k), 2.0 + k)
        size = size or (len(twin.state()) if k == MAX_SETTINGS + 2 else 0)
    assert len(twin.state()) < 1.1 * size
    versions = Versions()
    for k in range(MAX_ENDED_BOOTS + 10):
        versions = versions.noted(f"boot-{k}", 0)
    assert len(versions.ended_boots) == MAX_ENDED_BOOTS
    assert versions.has_ended(f"boot-{MAX_ENDED_BOOTS}")
    assert versions.noted(f"boot-{MAX_ENDED_BOOTS}", 7) is versions
