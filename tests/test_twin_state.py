"""A twin that is bytes between any two calls is the same twin, bit for bit."""

import math
from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from twin_messages import make, receipt, window_message

from servotwin.cosim import Cosimulation, Loop, simulation_of
from servotwin.edge.probe import ProbeLimits
from servotwin.errors import InvalidInput
from servotwin.identify.trend import Trend, TrendSettings
from servotwin.messages import Fallback, Gains, Hello
from servotwin.messages.updates import Cause
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.scenario import Recording, Scenario
from servotwin.twin.inforce import NEWEST, InForce
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import restored_trend, trend_state
from servotwin.twin.store import MemoryStore
from servotwin.twin.twin import Twin
from servotwin.twin.versions import EARLIER, Versions

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")


class Reborn:
    """A twin that dies after every call; what is left of it is its state."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.store, self.state, self.deaths = scenario, MemoryStore(), b"", 0

    def twin(self) -> Twin:
        s = self.scenario
        start = InForce(s.start_law, s.start_tolerance)
        return Twin.of(s.name, s.model, self.store, s.twin, start=start, state=self.state)

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
    machine = simulation_of(scenario)
    loop = Cosimulation(scenario, machine, twin=remote)
    if remote is not None:
        loop.store = remote.store
    while not loop.done:
        loop.advance()
    return loop.loop(machine.run())


def probed() -> Scenario:
    """Steps within the gap: the twin asks for longer windows, then for a probing move."""
    calm = Scenario.preset("calm")
    excitation = ExcitationSettings(probe=2e-4, interval=30.0)
    twin = calm.twin.replace(excitation=excitation, uncertainty=calm.twin.uncertainty.replace(gap=(0.0, 25.0 * DEG)))
    recording = Recording(probe=ProbeLimits(2e-4, 20.0))
    reference = SquareWave(2e-5, 20.0)
    return calm.replace(gap=10.0 * DEG, twin=twin, recording=recording, reference=reference, duration=35.0)


SCENARIOS = {
    "fig15": lambda: Scenario.preset("fig15").replace(duration=90.0),
    "certified": lambda: Scenario.preset("certified").replace(duration=62.0),
    "probed": probed,
}


@cache
def both(name: str) -> tuple[Loop, Loop, Reborn]:
    scenario = SCENARIOS[name]()
    remote = Reborn(scenario)
    return run(scenario), run(scenario, remote), remote


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_twin_that_dies_after_every_message_says_the_same(name):
    living, reborn, remote = both(name)
    assert living.digest() == reborn.digest()
    assert remote.deaths >= 4
    assert living.updates == reborn.updates
    assert living.requests == reborn.requests
    assert name != "probed" or living.requests


@pytest.mark.parametrize("name", SCENARIOS)
def test_and_finds_the_same(name):
    living, reborn, _ = both(name)
    assert len(living.estimates) >= 2
    for part in ("estimates", "disturbances", "excitations"):
        assert repr(getattr(living, part)) == repr(getattr(reborn, part))
    states = [
        [trend and msgspec.msgpack.encode(trend_state(trend)) for trend in loop.trends] for loop in both(name)[:2]
    ]
    assert states[0] == states[1]
    for one, other in zip(living.redesigns, reborn.redesigns, strict=True):
        assert (one.tolerance, one.reason, one.controller, one.band) == (
            other.tolerance,
            other.reason,
            other.controller,
            other.band,
        )


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_state_is_its_own_fixed_point(name):
    _, _, remote = both(name)
    assert remote.twin().state() == remote.state
    assert 200 < len(remote.state) < 10_000
