"""An agent that returns its windows with its letters, as if a perfect link sent each once."""

from typing import Any

from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.outlet import LocalOutlet
from servotwin.edge.recorder import Cut, Floats
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox import MemoryOutbox
from servotwin.messages import Acknowledge, Message


class _LoggingOutlet(LocalOutlet):
    """Outlet that notes the windows it has put into its outbox, and the sample at which each was cut."""

    def __init__(self, settings: AgentSettings, outbox: MemoryOutbox | None) -> None:
        super().__init__(settings, outbox)
        self.new = [ScheduledMessage(0, self.outbox.get(key)) for key in self.outbox.pending()]

    def offer(self, cut: Cut) -> None:
        before = set(self.outbox.pending())
        super().offer(cut)
        sample = cut.first + len(cut.signals["reference"])
        self.new += [ScheduledMessage(sample, self.outbox.get(k)) for k in self.outbox.pending() if k not in before]


class SendingAgent(Agent):
    """Agent over an outbox in memory; an acknowledgement empties it as the edge's session does."""

    def __init__(self, settings: AgentSettings, outbox: MemoryOutbox | None = None, **parts: Any) -> None:
        self.log = _LoggingOutlet(settings, outbox)
        super().__init__(settings, outlet=self.log, **parts)

    def absorb(self, reference: float, theta_m: float, position: float, voltage: float) -> list[ScheduledMessage]:
        return self._sent(super().absorb(reference, theta_m, position, voltage))

    def absorb_block(
        self, reference: Floats, theta_m: Floats, position: Floats, voltage: Floats
    ) -> list[ScheduledMessage]:
        return self._sent(super().absorb_block(reference, theta_m, position, voltage))

    def receive(self, message: Message) -> list[ScheduledMessage]:
        if isinstance(message, Acknowledge) and message.servo == self.settings.servo:
            self.log.outbox.remove((message.boot, message.sequence))
        return super().receive(message)

    def _sent(self, letters: list[ScheduledMessage]) -> list[ScheduledMessage]:
        windows, self.log.new = self.log.new, []
        return sorted(windows + letters, key=lambda out: out.sample)
