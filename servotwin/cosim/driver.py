"""Co-simulation: plant and law, edge agent, link and twin under one virtual clock.

Time is event time in seconds; the machine advances by whole samples. An event between two samples, or exactly at one,
takes effect at the later one, before that sample is taken. The plant advances only as far as nothing can happen to it:
to the next event, to the agent's deadline, and at most to the sample at which a change of the reference that has not
been recorded yet could complete a window; during a probing move, to the next change of the reference.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Protocol

import numpy as np

from servotwin.control.gains import gains_of
from servotwin.cosim.loop import Loop, MessageCopy
from servotwin.cosim.machine import Machine, SimulatedMachine
from servotwin.cosim.scenario import Scenario
from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.drive import SettingWriter
from servotwin.edge.outlet import CHANNELS
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox import MemoryOutbox, letter_digest
from servotwin.link.session import Session
from servotwin.link.simulated import Event, LinkDirection, SimulatedLink, SimulatedSender, VirtualClock
from servotwin.messages import (
    Acknowledge,
    Answer,
    Fallback,
    LetterAcknowledge,
    Message,
    Receipt,
    Request,
    Setting,
    Update,
    WindowMessage,
    decode,
    encode,
)
from servotwin.plant.signals import as_pieces
from servotwin.simulation import Run
from servotwin.twin.estimating import Estimator
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.model import TwinModel
from servotwin.twin.twin import Twin

Progress = Callable[[float], object]
"""Callback with the completed share, 0 .. 1."""

_ROUNDING = 1e-6  # of a sample: a sum of delays may exceed the sample's time by rounding


def cosimulate(scenario: Scenario, progress: Progress | None = None, estimator: Estimator | None = None) -> Loop:
    """Run a scenario: same scenario, same bytes.

    Parameters
    ----------
    scenario : Scenario
    progress : callable, optional
        Called with the completed share, 0 .. 1, at least once per window length.
    estimator : callable, optional
        Replaces the twin's own: (estimation.Window, Expectation) -> GapEstimate.

    Returns
    -------
    Loop
    """
    machine = SimulatedMachine(scenario)
    cosimulation = Cosimulation(scenario, machine, estimator)
    while not cosimulation.done:
        cosimulation.advance()
        if progress is not None:
            progress(cosimulation.share)
    return cosimulation.loop(machine.run())


class SimulatedEdge:
    """The deployed edge's agent, outbox and session, on a simulated machine and link.

    Parameters
    ----------
    settings : AgentSettings
    machine : Machine
        It begins with the parameters of the settings in force.
    clock : VirtualClock
    line : LinkDirection
        To the twin.

    Attributes
    ----------
    agent : Agent
    outbox : MemoryOutbox
    receipts, fallbacks, answers : list
        Letters, in the order in which the agent wrote them.
    """

    def __init__(self, settings: AgentSettings, machine: Machine, clock: VirtualClock, line: LinkDirection) -> None:
        self.outbox = MemoryOutbox()
        self.agent = Agent(settings, self.outbox)
        self.receipts: list[Receipt] = []
        self.fallbacks: list[Fallback] = []
        self.answers: list[Answer] = []
        self._machine = machine
        # Retries are not spread at random: a run is the same each time.
        self._sender = SimulatedSender(Session(self.outbox, settings.retry), clock, line)
        self._writer = SettingWriter(machine, self.agent.parameters)

    def advance(self, stop: int) -> None:
        """Advance the machine to a sample, and have the agent take the samples before it."""
        first = self._machine.index
        self._machine.advance(stop)
        letters = self.agent.absorb_block(*(self._machine.measured(name, first, stop) for name in CHANNELS))
        self._writer.write(self.agent)
        self._store(letters)
        self._sender.plan(self.agent.time)

    def receive(self, data: bytes) -> None:
        """Take bytes that arrived from the twin."""
        message = decode(data)
        if isinstance(message, LetterAcknowledge):
            self._sender.acknowledge(message.digest)
            return
        if isinstance(message, Acknowledge):
            # Before the agent, which looks if others still wait.
            self._sender.acknowledge((message.boot, message.sequence))
        letters = self.agent.receive(message)
        self._writer.write(self.agent)
        self._store(letters)
        self._sender.send_due()

    def _store(self, letters: list[ScheduledMessage]) -> None:
        for _, letter in letters:
            if isinstance(letter, Receipt):
                self.receipts.append(letter)
            elif isinstance(letter, Fallback):
                self.fallbacks.append(letter)
            elif isinstance(letter, Answer):
                self.answers.append(letter)
            self.outbox.put_letter(encode(letter))


class Remote(Protocol):
    """Twin that answers the edge, or a hostile one in a test."""

    def receive(self, message: Message, now: float) -> list[Message]:
        """Return the answers to a message that arrived at `now` (s)."""

    def next_wake(self) -> float | None:
        """Return the time at which `wake` is due, s; None: no answer is pending."""

    def wake(self, now: float) -> list[Message]:
        """Return the messages that are due at `now` (s)."""


class Cosimulation:
    """Machine, agent, link and twin, and the clock that connects them; `advance` it until it is `done`.

    Parameters
    ----------
    scenario : Scenario
    machine : Machine
    estimator : callable, optional
        Replaces the twin's own.
    twin : Remote, optional
        Replaces the twin that the scenario describes.
    """

    def __init__(
        self, scenario: Scenario, machine: Machine, estimator: Estimator | None = None, twin: Remote | None = None
    ) -> None:
        self.scenario = scenario
        self.clock = VirtualClock()
        self.machine = machine
        self.store = EvidenceLog()
        self.twin = None if not scenario.twin.enabled else twin or self._described_twin(estimator)
        self.link = SimulatedLink(
            scenario.name,
            self.clock,
            self._at_twin,
            lambda data: self.edge.receive(data),
            scenario.uplink,
            scenario.downlink,
            scenario.seed,
        )
        self.edge = SimulatedEdge(scenario.agent_settings(), machine, self.clock, self.link.up)
        self._reference = as_pieces(scenario.reference, scenario.duration)
        self._letters: set[bytes] = set()
        self._wake: Event | None = None

    def _described_twin(self, estimator: Estimator | None) -> Remote:
        scenario = self.scenario
        start = Setting.of(scenario.start_tolerance, gains_of(scenario.start_law))
        model = TwinModel.of(scenario.model, scenario.twin, start, estimator)
        return Twin(scenario.name, model, self.store)

    @property
    def done(self) -> bool:
        """True at the last sample."""
        return self.machine.index == self.machine.samples - 1

    @property
    def share(self) -> float:
        """Completed share of the samples, 0 .. 1."""
        return self.machine.index / (self.machine.samples - 1)

    def advance(self) -> None:
        """Advance to the next sample at which an event is possible, and process its events."""
        stop = self._next_stop()
        self.edge.advance(stop)
        while (due := self.clock.next_time) is not None and self._sample_at(due) <= stop:
            self.clock.step()

    def loop(self, run: Run) -> Loop:
        """Return the result so far, with the machine's run."""
        return Loop(
            scenario=self.scenario,
            run=run,
            windows=tuple(self.store.windows.values()),
            estimates=tuple(self.store.estimates.values()),
            disturbances=tuple(self.store.disturbances.values()),
            trends=tuple(self.store.trends.values()),
            redesigns=tuple(self.store.redesigns.values()),
            updates=tuple(self.store.updates),
            receipts=tuple(self.edge.receipts),
            fallbacks=tuple(self.edge.fallbacks),
            excitations=tuple(self.store.excitations.values()),
            requests=tuple(self.store.requests),
            answers=tuple(self.edge.answers),
            messages=tuple(sorted(self._transmissions(), key=lambda m: (m.sent, m.direction, m.serial, m.copy))),
            accounts=self._accounts(),
        )

    def _next_stop(self) -> int:
        """Sample up to which nothing can happen to the machine (see the module)."""
        index, agent = self.machine.index, self.edge.agent
        stops = [index + agent.shortest_wait, self.machine.samples - 1]
        if self.clock.next_time is not None:
            stops.append(self._sample_at(self.clock.next_time))
        if agent.deadline is not None:
            stops.append(agent.deadline)
        return max(min(stops) if agent.probe is None else self._before_moving(min(stops)), index + 1)

    def _before_moving(self, stop: int) -> int:
        """Sample at which the reference first changes, at most `stop`."""
        first = self.machine.index - 1
        references = self._reference.on(np.arange(first, stop) / self.scenario.recording.sample_rate)
        moved = np.flatnonzero(references != references[0])
        return first + int(moved[0]) + 1 if moved.size else stop

    def _sample_at(self, time: float) -> int:
        """First sample at or after a time."""
        return math.ceil(time * self.scenario.recording.sample_rate - _ROUNDING)

    def _at_twin(self, data: bytes) -> None:
        """Receive bytes at the twin, if there is one."""
        if self.twin is None:
            return
        message = decode(data)
        if isinstance(message, WindowMessage) or self._is_new_letter(message, data):
            self._answer(self.twin, self.twin.receive(message, self.clock.now))

    def _is_new_letter(self, message: Message, data: bytes) -> bool:
        """Acknowledge a letter, as the deployed twin does once it is stored; False for one that came before."""
        digest = letter_digest(data)
        new = digest not in self._letters
        self._letters.add(digest)
        self.link.down.send(encode(LetterAcknowledge(message.servo, digest)))
        return new

    def _wake_twin(self, twin: Remote) -> None:
        self._wake = None
        self._answer(twin, twin.wake(self.clock.now))

    def _answer(self, twin: Remote, messages: Iterable[Message]) -> None:
        """Send the twin's messages, updates after its processing time, and schedule its next wake."""
        for message in messages:
            delay = self.scenario.twin.processing if isinstance(message, Update | Request) else 0.0
            self.clock.schedule(self.clock.now + delay, partial(self.link.down.send, encode(message)))
        if self._wake is not None:
            self.clock.cancel(self._wake)
        due = twin.next_wake()
        wake = partial(self._wake_twin, twin)
        self._wake = None if due is None else self.clock.schedule(max(due, self.clock.now), wake)

    def _transmissions(self) -> Iterable[MessageCopy]:
        for direction, line in (("up", self.link.up), ("down", self.link.down)):
            for r in line.records:
                yield MessageCopy(direction, r.serial, r.copy, r.data, r.sent, r.arrival, r.fate)

    def _accounts(self) -> Counter[str]:
        delivered = {(boot, sequence) for _, boot, sequence in self.store.windows}
        waiting = [key for key in self.edge.outbox.pending() if key not in delivered]
        counts = Counter({"delivered": len(delivered), "in flight": len(waiting)})
        return +(counts + self.edge.agent.dropped)
