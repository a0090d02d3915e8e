"""Agent and real twin over random fates of the link, on a machine that is not simulated."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.cosim import Cosimulation
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.edge.guard import Limits
from servotwin.estimation import paper
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.link.simulated import Fate, LinkSettings
from servotwin.messages import Update
from servotwin.plant.servo import Servo
from servotwin.runtime.retry import Retry
from servotwin.twin.settings import TwinSettings

RATE, DURATION, STEP = 50.0, 60.0, 3.0
PAPER = Servo.preset("paper")


@dataclass
class Stub:
    """Channels without physics: the reference steps every 3 s for the first half."""

    samples: int = round(RATE * DURATION) + 1
    index: int = 0
    tolerances: list[tuple[int, float]] = field(default_factory=list)

    def advance(self, index):
        assert index > self.index
        self.index = index

    def measured(self, name, first, last):
        assert last <= self.index
        time = np.arange(first, last) / RATE
        return 1e-3 * np.floor(np.minimum(time, DURATION / 2) / STEP) if name == "reference" else np.sin(time)

    def write(self, parameters):
        self.tolerances.append((self.index, parameters.setting.tolerance))

    def move(self, offset):
        raise AssertionError(f"nobody asked for a probing move, of {offset} m")


def fake(window, _previous):
    """A gap that grows with the window's time; every fifth window shows none."""
    status = GapStatus.OK if round(window.start / STEP) % 5 else GapStatus.UNIDENTIFIABLE
    return GapEstimate(0.01 * window.start, 0.0, 0.0, (0.0, 1.0), status, window.mid_time)


LINKS = st.builds(
    LinkSettings,
    delay_s=st.sampled_from([0.0, 0.1, 1.0]),
    jitter_s=st.sampled_from([0.0, 0.3, 5.0]),
    loss=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
    duplicate=st.sampled_from([0.0, 0.5, 1.0]),
    reorder=st.sampled_from([0.0, 0.5]),
    hold_s=st.sampled_from([0.5, 6.0]),
    outages=st.lists(st.tuples(st.floats(0.0, 10.0), st.floats(10.5, 28.0)), max_size=1).map(tuple),
)


def run(uplink, downlink, seed, twin, interval_s=0.0):
    recording = Recording(RATE, 0.6, 0.2, Retry(1.5, 2.0, 4.0), Limits(interval_s=interval_s))
    twin = twin.replace(policy="paper", method="paper", estimator=paper.PaperSettings(settle_s=0.0))
    scenario = Scenario(PAPER, DURATION, seed, uplink=uplink, downlink=downlink, recording=recording, twin=twin)
    loop = Cosimulation(scenario, Stub(), fake)
    while not loop.done:
        loop.advance()
    return loop


TWINS = st.builds(
    TwinSettings,
    processing=st.sampled_from([0.0, 0.7]),
    validity=st.sampled_from([2.0, 10.0, 1e6]),
    retry=st.sampled_from([0.4, 2.0]),
    attempts=st.sampled_from([1, 5]),
)
SEEDS = st.integers(0, 2**63)


@pytest.mark.slow
@examples(60)
@given(LINKS, LINKS, SEEDS, TWINS, st.sampled_from([0.0, 4.0]))
def test_nothing_twice_nothing_older_nothing_unaccounted_for(uplink, downlink, seed, twin, interval_s):
    loop = run(uplink, downlink, seed, twin, interval_s)
    made = {update.version: update for update in loop.store.updates}
    assert list(made) == sorted(made)
    applied = {receipt.version: receipt.sample for receipt in loop.edge.receipts if receipt.applied}
    assert len(applied) == len(loop.machine.tolerances)
    assert list(applied) == sorted(applied)
    times = [made[version].data_time for version in applied]
    assert times == sorted(times)
    assert [(s, made[v].setting.tolerance) for v, s in applied.items()] == loop.machine.tolerances
    assert all(sample / RATE < made[version].not_after for version, sample in applied.items())
    assert len(loop.store.windows) == len(loop.store.estimates)
    records = loop.loop(None)
    assert sum(records.accounts.values()) == loop.edge.agent.windows_cut == 10
    in_flight = [m for m in records.messages if m.fate is Fate.IN_FLIGHT]
    assert all(m.arrival > DURATION - 2.0 / RATE for m in in_flight)


@pytest.mark.slow
@given(
    st.floats(0.0, 0.4),
    st.floats(0.0, 1.0),
    st.sampled_from([0.0, 2.0]),
    SEEDS,
)
def test_a_link_that_lives_brings_the_newest_parameters_in_the_end(loss, duplicate, jitter, seed):
    link = LinkSettings(0.1, jitter, loss, duplicate, reorder=0.3)
    loop = run(link, link, seed, TwinSettings(validity=1e6, retry=1.0, attempts=100))
    newest = max(w.start for w in loop.store.windows.values() if fake_ok(w.start))
    assert newest == 29.8 - 3.0 * (round(29.8 / STEP) % 5 == 0)
    assert loop.machine.tolerances[-1][1] == PAPER.tolerance_for(0.01 * newest)
    assert loop.twin.next_wake() is None
    assert loop.edge.outbox.pending() == loop.edge.outbox.letters() == []
    assert len(loop.store.windows) == loop.edge.agent.windows_cut
    once = list(dict.fromkeys(loop.edge.receipts))  # an update that comes again gets the same receipt
    assert sorted(loop.store.receipts, key=once.index) == once


def fake_ok(start):
    return round(start / STEP) % 5 != 0


def test_equal_fates_give_equal_bytes():
    link = LinkSettings(0.1, 2.0, 0.3, 0.3, 0.3)
    one, two, other = (run(link, link, seed, TwinSettings(retry=1.0)).loop(None).messages for seed in (1, 1, 2))
    assert one == two != other
    assert any(isinstance(m.message, Update) for m in one)
