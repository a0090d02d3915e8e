"""The edge of a co-simulation: the deployed edge's agent, outbox and session, on a simulated machine and link."""

from __future__ import annotations

from servotwin.cosim.machine import Machine
from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.drive import SettingWriter
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox import MemoryOutbox
from servotwin.link.session import Session
from servotwin.link.simulated import LinkDirection, SimulatedSender
from servotwin.messages import Acknowledge, Answer, Fallback, LetterAcknowledge, Receipt, decode, encode
from servotwin.runtime.clock import VirtualClock

CHANNELS = ("reference", "theta_m", "position", "voltage")


class SimulatedEdge:
    """An agent whose windows and letters stay in an outbox until the twin acknowledges them.

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
