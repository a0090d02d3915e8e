"""An agent and a minimal twin over a hostile link: nothing twice, nothing older, nothing unaccounted for."""

from dataclasses import dataclass, field

import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox import MemoryOutbox, letter_digest
from servotwin.link.session import Session
from servotwin.link.simulated import Fate, LinkSettings, SimulatedLink, SimulatedSender, VirtualClock
from servotwin.messages import (
    Acknowledge,
    LetterAcknowledge,
    Message,
    Reason,
    Receipt,
    Setting,
    Update,
    WindowMessage,
    decode,
    encode,
)
from servotwin.runtime.retry import Retry

RATE, STEPS, HOSTILE_S, TAIL_S = 10.0, 10, 20.0, 40.0
"""Tiny windows of four samples, a reference step every two seconds, then a clean link to settle on."""


def make_update(version: int, base: int, window: WindowMessage, lifetime_s: float) -> Update:
    """An update whose tolerance tells its window."""
    known, start = (None, None, (None, None)), window.start
    tolerance = 1e-5 * (1 + window.sequence)
    identity = (window.boot, window.sequence)
    return Update("axis-1", version, base, identity, start, *known, "OK", Setting(tolerance), start + lifetime_s)


@dataclass
class StubTwin:
    """Makes a tolerance of every window, and insists on the newest until the edge has it."""

    lifetime_s: float
    version: int = 0
    base: int = 0
    newest: WindowMessage | None = None
    pending: Update | None = None
    seen: set[int] = field(default_factory=set)

    def receive(self, message: Message) -> list[Message]:
        if isinstance(message, WindowMessage):
            return self._window(message)
        if isinstance(message, Receipt) and self.pending and message.version == self.pending.version:
            return self._receipt(message)
        return []

    def repeat(self) -> list[Message]:
        return [self.pending] if self.pending else []

    def _window(self, window: WindowMessage) -> list[Message]:
        self.seen.add(window.sequence)
        answer: list[Message] = [Acknowledge(window.servo, window.boot, window.sequence)]
        if self.newest is None or window.start > self.newest.start:
            self.newest = window
            answer += self._issue(window)
        return answer

    def _receipt(self, receipt: Receipt) -> list[Message]:
        self.base, self.pending = receipt.parameter_version, None
        refused = receipt.reason in (Reason.BASE_MISMATCH, Reason.OLD_VERSION)
        return self._issue(self.newest) if refused and self.newest else []

    def _issue(self, window: WindowMessage) -> list[Message]:
        self.version = max(self.version, self.base) + 1
        self.pending = make_update(self.version, self.base, window, self.lifetime_s)
        return [self.pending]


@dataclass
class CarelessTwin:
    """Takes windows as they come, guesses bases, uses versions twice, repeats what it said, listens to no receipt.

    So the guard alone has to keep order.
    """

    lifetime_s: float
    version: int = 1
    updates: list[Message] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)

    def receive(self, message: Message) -> list[Message]:
        if not isinstance(message, WindowMessage):
            return []
        self.seen.add(message.sequence)
        self.version += message.sequence % 3 != 0
        base = max(0, self.version - 1 - message.sequence % 2)
        self.updates.append(make_update(self.version, base, message, self.lifetime_s))
        return [Acknowledge(message.servo, message.boot, message.sequence), self.updates[-1]]

    def repeat(self) -> list[Message]:
        return self.updates[-6:]


class Loop:
    """Everything joined on one virtual clock."""

    def __init__(self, link: LinkSettings, seed: int, capacity: int, twin: StubTwin | CarelessTwin) -> None:
        self.clock = VirtualClock()
        edge = AgentSettings("axis-1", "b0", RATE, 0.4, 0.1, Retry(1.5, 2.0, 4.0), Limits(maximum=1.0))
        self.outbox = MemoryOutbox(capacity)
        self.agent, self.twin = Agent(edge, self.outbox), twin
        self.link = SimulatedLink("axis-1", self.clock, self._at_twin, self._at_edge, link, link, seed)
        self.sender = SimulatedSender(Session(self.outbox, edge.retry), self.clock, self.link.up)
        self.history: list[Parameters] = []
        self.swaps: list[tuple[int, int]] = []
        self.receipts: list[Receipt] = []
        self.acknowledged: set[int] = set()
        self.letters: list[bytes] = []

    def run(self, until: float) -> None:
        """Sample by sample; what arrives at a sample instant comes before the sample."""
        while self.agent.time < until:
            now = self.agent.time
            self.clock.run_until(now)
            if self.agent.samples % 10 == 0:
                self._down(self.twin.repeat())
            reference = 1e-3 * min(STEPS, 1 + int(now / 2.0))
            self._up(self.agent.absorb(reference, 0.1 * now, 0.01 * now, 0.0))

    def _at_twin(self, data: bytes) -> None:
        message, digest = decode(data), letter_digest(data)
        if isinstance(message, WindowMessage):
            self._down(self.twin.receive(message))
            return
        self._down([LetterAcknowledge("axis-1", digest)])
        if digest not in self.letters:
            self.letters.append(digest)
            self._down(self.twin.receive(message))

    def _at_edge(self, data: bytes) -> None:
        message, before = decode(data), self.agent.parameters
        if isinstance(message, LetterAcknowledge):
            self.sender.acknowledge(message.digest)
            return
        if isinstance(message, Acknowledge):
            self.sender.acknowledge((message.boot, message.sequence))
            self.acknowledged.add(message.sequence)
        self._up(self.agent.receive(message))
        if self.agent.parameters is not before:
            assert isinstance(message, Update)
            self.history.append(self.agent.parameters)
            self.swaps.append((message.base_version, before.version))

    def _up(self, sent: list[ScheduledMessage]) -> None:
        for out in sent:
            if isinstance(out.message, Receipt):
                self.receipts.append(out.message)
            self.outbox.put_letter(encode(out.message))
        self.sender.plan(self.agent.time)

    def _down(self, sent: list[Message]) -> None:
        for message in sent:
            self.link.down.send(encode(message))


LINKS = st.builds(
    LinkSettings,
    delay_s=st.sampled_from([0.0, 0.1, 1.0]),
    jitter_s=st.sampled_from([0.0, 0.3, 3.0]),
    loss=st.sampled_from([0.0, 0.2, 0.6]),
    duplicate=st.sampled_from([0.0, 0.5, 1.0]),
    reorder=st.sampled_from([0.0, 0.5]),
    hold_s=st.sampled_from([0.5, 5.0]),
    outages=st.lists(st.tuples(st.floats(0.0, 10.0), st.floats(10.5, 18.0)), max_size=1).map(tuple),
)
SEEDS = st.integers(0, 2**64 - 1)
CAPACITIES = st.sampled_from([1, 2, 100])
LIFETIMES = st.sampled_from([1.0, 3.0, 1e6])


def check_parameters(loop: Loop) -> None:
    """No update applied twice, none older than the last applied, none on a base that was not in force."""
    assert all(base == in_force for base, in_force in loop.swaps)
    versions = [parameters.version for parameters in loop.history]
    assert versions == sorted(set(versions))
    times = [parameters.data_time for parameters in loop.history]
    assert times == sorted(set(times))
    applied = {(receipt.version, receipt.sample) for receipt in loop.receipts if receipt.applied}
    assert applied == {(parameters.version, parameters.sample) for parameters in loop.history}
    assert all(p.sample / RATE < p.data_time + loop.twin.lifetime_s for p in loop.history)


def check_windows(loop: Loop) -> None:
    """Every window is with the twin, still in the outbox, or dropped with a reason."""
    pending = {sequence for _, sequence in loop.outbox.pending()}
    dropped = {drop.key[1] for drop in loop.outbox.recently_dropped}
    assert loop.twin.seen | pending | dropped == set(range(loop.agent.windows_cut))
    assert not pending & dropped
    assert loop.acknowledged <= loop.twin.seen
    assert not loop.acknowledged & pending
    assert loop.agent.windows_cut == len(loop.acknowledged | pending | dropped)
    assert sum(loop.agent.dropped.values()) == len(dropped)


def check_bytes(loop: Loop) -> None:
    """Every message offered was delivered, lost with a reason, or is still in flight."""
    for line in (loop.link.up, loop.link.down):
        assert {record.serial for record in line.records} == set(range(line.offered))
        in_flight = line.tally()[Fate.IN_FLIGHT]
        assert in_flight == sum(
            r.arrival > loop.clock.now for r in line.records if r.fate not in (Fate.LOST, Fate.OUTAGE)
        )


@pytest.mark.slow
@examples(150, deadline=None)
@given(LINKS, SEEDS, CAPACITIES, LIFETIMES, st.booleans())
def test_windows_and_parameters_are_consistent_over_any_link(
    link: LinkSettings, seed: int, capacity: int, lifetime_s: float, careless: bool
) -> None:
    loop = Loop(link, seed, capacity, CarelessTwin(lifetime_s) if careless else StubTwin(lifetime_s))
    loop.run(HOSTILE_S)
    assert loop.agent.windows_cut == STEPS
    check_parameters(loop)
    check_windows(loop)
    check_bytes(loop)


@pytest.mark.slow
@examples(40, deadline=None)
@given(LINKS, SEEDS)
def test_the_newest_window_wins_once_the_link_recovers(link: LinkSettings, seed: int) -> None:
    loop = Loop(link, seed, 100, twin := StubTwin(1e6))
    loop.run(HOSTILE_S)
    loop.link.up.settings = loop.link.down.settings = LinkSettings(delay_s=0.2)
    loop.run(HOSTILE_S + TAIL_S)
    check_parameters(loop)
    assert loop.twin.seen == set(range(STEPS))
    assert loop.outbox.pending() == loop.outbox.letters() == []
    assert sorted(loop.letters) == sorted({letter_digest(encode(receipt)) for receipt in loop.receipts})
    assert loop.history[-1].window == ("b0", STEPS - 1)
    assert twin.pending is None


@pytest.mark.slow
@examples(25, deadline=None)
@given(LINKS, SEEDS, CAPACITIES, LIFETIMES)
def test_equal_seeds_give_equal_bytes(link: LinkSettings, seed: int, capacity: int, lifetime_s: float) -> None:
    first, second = (Loop(link, seed, capacity, StubTwin(lifetime_s)) for _ in range(2))
    for loop in (first, second):
        loop.run(HOSTILE_S)
    assert first.link.up.records == second.link.up.records
    assert first.link.down.records == second.link.down.records
    assert first.history == second.history


def test_on_a_clean_link_every_window_moves_the_parameters_once() -> None:
    loop = Loop(LinkSettings(delay_s=0.12), 0, 100, StubTwin(1e6))
    loop.run(HOSTILE_S)
    assert [parameters.window for parameters in loop.history] == [("b0", k) for k in range(STEPS)]
    assert [parameters.version for parameters in loop.history] == list(range(1, STEPS + 1))
    complete = [4, *(20 * k + 3 for k in range(1, STEPS))]
    assert [parameters.sample for parameters in loop.history] == [sample + 3 for sample in complete]
    assert {receipt.reason for receipt in loop.receipts} == {Reason.APPLIED}
