"""The simulated link: every message accounted for, every draw repeatable."""

from collections import Counter
from math import inf, nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.link.outbox import MemoryOutbox, letter_digest
from servotwin.link.session import Session
from servotwin.link.simulated import (
    Fate,
    LinkDirection,
    LinkSettings,
    SimulatedLink,
    SimulatedSender,
    VirtualClock,
    derive_seed,
)
from servotwin.runtime.retry import Retry

PROBABILITY = st.sampled_from([0.0, 0.1, 0.5, 1.0])
SETTINGS = st.builds(
    LinkSettings,
    delay_s=st.floats(0.0, 2.0),
    jitter_s=st.floats(0.0, 2.0),
    loss=PROBABILITY,
    duplicate=PROBABILITY,
    reorder=PROBABILITY,
    outages=st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(5.1, 9.0)), max_size=1).map(tuple),
)


def play(
    settings: LinkSettings, seed: int, messages: int = 20, until: float = 100.0
) -> tuple[LinkDirection, list[bytes]]:
    """A line with one message every half second; what arrived."""
    clock, arrived = VirtualClock(), list[bytes]()
    line = LinkDirection("axis-1/up", clock, arrived.append, settings, seed)
    for k in range(messages):
        clock.run_until(0.5 * k)
        line.send(b"%d" % k)
    clock.run_until(until)
    return line, arrived


@given(SETTINGS, st.integers(0, 2**32), st.floats(9.5, 20.0))
def test_every_copy_is_accounted_for_at_any_time(settings: LinkSettings, seed: int, until: float) -> None:
    line, arrived = play(settings, seed, until=until)
    tally = line.tally()
    originals = [record for record in line.records if record.copy == 0]
    assert [record.serial for record in originals] == list(range(line.offered))
    assert sum(tally.values()) == len(line.records)
    assert tally[Fate.DELIVERED] == len(arrived)
    assert Counter(arrived) == Counter(r.data for r in line.records if r.fate is Fate.DELIVERED)
    for record in line.records:
        assert record.data == b"%d" % record.serial
        assert settings.delay_s <= record.arrival - record.sent + 1e-9
        assert (record.fate is Fate.IN_FLIGHT) <= (record.arrival > until)
        assert (record.fate is Fate.OUTAGE) <= (settings.out(record.sent) or settings.out(record.arrival))


@given(SETTINGS, st.integers(0, 2**32))
def test_equal_seeds_give_equal_fates(settings: LinkSettings, seed: int) -> None:
    (first, arrived), (second, again) = play(settings, seed), play(settings, seed)
    assert first.records == second.records
    assert arrived == again


def test_a_clean_link_only_delays_and_keeps_order() -> None:
    line, arrived = play(LinkSettings(delay_s=1.0), 0)
    assert arrived == [b"%d" % k for k in range(20)]
    assert {record.arrival - record.sent for record in line.records} == {1.0}


def test_probabilities_are_met() -> None:
    settings = LinkSettings(delay_s=0.1, jitter_s=0.2, loss=0.3, duplicate=0.2, reorder=0.1, hold_s=5.0)
    line, arrived = play(settings, 5, messages=4000, until=1e5)
    assert line.tally()[Fate.LOST] == pytest.approx(0.3 * 4000, rel=0.1)
    assert sum(record.copy for record in line.records) == pytest.approx(0.2 * 0.7 * 4000, rel=0.15)
    held = [record for record in line.records if record.arrival - record.sent > 0.3]
    assert len(held) == pytest.approx(0.1 * len(line.records), rel=0.15)
    assert arrived != sorted(arrived, key=int)


def test_one_setting_leaves_the_draws_of_the_others_alone() -> None:
    base: dict[str, Any] = {"delay_s": 0.1, "jitter_s": 0.2, "loss": 0.2}
    plain, _ = play(LinkSettings(**base), 3)
    doubled, _ = play(LinkSettings(**base, duplicate=0.5), 3)
    assert [(r.arrival, r.fate) for r in doubled.records if r.copy == 0] == [(r.arrival, r.fate) for r in plain.records]


def test_outages_lose_messages_sent_or_arriving_in_them() -> None:
    line, arrived = play(LinkSettings(delay_s=1.0, outages=((3.0, 4.0), (8.0, 8.1))), 0)
    lost = [record.sent for record in line.records if record.fate is Fate.OUTAGE]
    assert lost == [2.0, 2.5, 3.0, 3.5, 7.0, 8.0]
    assert len(arrived) == 14


def test_directions_and_servos_have_their_own_randomness() -> None:
    clock, settings = VirtualClock(), LinkSettings(jitter_s=1.0)
    one, two = (SimulatedLink(name, clock, len, len, settings, settings, 1) for name in ("axis-1", "axis-2"))
    lines = (one.up, one.down, two.up, two.down)
    for line in lines:
        line.send(b"")
    assert len({line.records[0].arrival for line in lines}) == 4


def test_seeds_are_stable_across_machines_and_runs() -> None:
    assert derive_seed(0, "axis-1", "noise") == 3245227320476969261
    assert derive_seed(0, "axis-1", "noise") != derive_seed(0, "axis-1noise")
    assert derive_seed(1, "axis-1", "noise") != derive_seed(0, "axis-1", "noise")


@pytest.mark.parametrize(
    "values",
    [{"delay_s": -1.0}, {"jitter_s": inf}, {"hold_s": nan}, {"loss": 1.1}, {"duplicate": -0.1}, {"reorder": nan},
     {"outages": ((2.0, 1.0),)}, {"outages": ((2.0, inf),)}],
)  # fmt: skip
def test_bad_settings_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="link"):
        LinkSettings(**values)


class Exchange:
    """Letters over a lossy link: who receives one acknowledges it by its digest, each time."""

    def __init__(self, link: LinkSettings, retry: Retry, seed: int = 1) -> None:
        self.clock, self.outbox, self.arrived = VirtualClock(), MemoryOutbox(), list[bytes]()
        self.down = LinkDirection("down", self.clock, lambda digest: self.sender.acknowledge(digest), link, seed)
        self.up = LinkDirection("up", self.clock, self._receive, link, seed)
        self.sender = SimulatedSender(Session(self.outbox, retry), self.clock, self.up)

    def post(self, body: bytes) -> None:
        self.outbox.put_letter(body)
        self.sender.send_due()

    def _receive(self, body: bytes) -> None:
        self.arrived.append(body)
        self.down.send(letter_digest(body))


def test_a_sender_repeats_with_growing_pauses_until_the_acknowledgement() -> None:
    cut = LinkSettings(delay_s=0.25, outages=((0.0, 8.0),))
    exchange = Exchange(cut, Retry(1.0, 2.0, 4.0))
    exchange.post(b"receipt")
    exchange.clock.run_until(60.0)
    assert [record.sent for record in exchange.up.records] == [0.0, 1.0, 3.0, 7.0, 11.0]
    assert exchange.arrived == [b"receipt"]
    assert exchange.outbox.letters() == []
    assert exchange.clock.next_time is None


def test_the_first_send_may_be_planned_for_a_later_sample() -> None:
    exchange = Exchange(LinkSettings(), Retry(1.0))
    exchange.outbox.put_letter(b"receipt")
    exchange.sender.plan(3.5)
    exchange.clock.run_until(10.0)
    assert [record.sent for record in exchange.up.records] == [3.5]


@pytest.mark.slow
def test_the_number_of_tries_is_geometric() -> None:
    """Each try succeeds with probability (1 - loss)^2: mean 1 / p, variance (1 - p) / p^2."""
    loss, letters = 0.3, 500
    exchange = Exchange(LinkSettings(delay_s=0.1, loss=loss), Retry(1.0, 1.0, 1.0))
    for k in range(letters):
        exchange.post(b"%d" % k)
    exchange.clock.run_until(1000.0)
    assert set(exchange.arrived) == {b"%d" % k for k in range(letters)}
    assert exchange.outbox.letters() == []
    success = (1.0 - loss) ** 2
    spread = ((1.0 - success) / success**2 / letters) ** 0.5
    assert abs(exchange.up.offered / letters - 1.0 / success) < 4.0 * spread
