"""Back up, restart the edge twice, restore: the live boot's windows go first, and its updates still arrive."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
from twin_messages import known_gap, twin_of

from servotwin.edge.agent import Agent
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.link.outbox_index import AcknowledgedLimits
from servotwin.link.session import Sender, Session
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.link.transport import Parcel, Refused
from servotwin.messages import Message, Resend, Setting, encode
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.state import decode_state
from servotwin.twin.twin import Twin
from servotwin.twin_service.ingest import Clocks, Ingest
from servotwin.twin_service.limits import RateLimiter, RequestRejected, SampleTimeLimiter
from servotwin.twin_service.monitoring import Metrics

PERIOD_S = 20.0
"""s between two windows."""
BETWEEN = 150
"""Windows of the boot that began after the backup and ended before the restore: nearly an hour."""


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Rule:
    """A policy whose tolerance follows the gap, within what an edge allows."""

    needs_estimate = True

    def redesign(self, evidence: Evidence) -> Redesign:
        gap = evidence.estimate.gap
        return Redesign(Setting(1e-6 * (1.0 + gap)), gap, "")


class Service:
    """A twin's ingest with its limits, and the twin of one servo; its store is in memory."""

    def __init__(self, twin: Twin, clock: Clock) -> None:
        self.twin, self.clock = twin, clock
        self.outgoing: list[Message] = []
        self.order: list[str] = []
        self.rate = RateLimiter(20.0, 200.0, clock)
        limiter = SampleTimeLimiter(1.0, 60.0)
        self.ingest = Ingest(None, lambda _: True, limiter, Metrics(), clocks=Clocks(clock, clock))  # type: ignore[arg-type]

    def deliver(self, parcel: Parcel) -> float:
        """A transport's call: take a message, or refuse it."""
        self.clock.now += 0.005
        try:
            self.rate.take(parcel.servo)
            _, message = self.ingest.read(parcel.servo, parcel.body, parcel.encoding)
        except RequestRejected as error:
            raise Refused(error.refusal, str(error.detail)) from None
        self.order.append(parcel.boot)
        self.outgoing += self.twin.receive(message, self.clock())
        return 0.0


class Edge:
    """Agent, outbox and session of one boot after the other."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self.clock = clock
        self.outbox = SqliteOutbox(path, "axis", kept=AcknowledgedLimits(10**9, 1e9))
        self.session = Session(self.outbox)
        self.start("backup", Parameters())

    def start(self, boot: str, parameters: Parameters) -> None:
        settings = AgentSettings(servo="axis", boot=boot, sample_rate=1.0, window_s=16.0, parameters=parameters)
        self.agent = Agent(settings, self.outbox)
        self.outbox.put_letter(encode(self.agent.hello()))

    def restart(self, boot: str) -> None:
        now = self.agent.parameters
        self.start(boot, Parameters(now.version, now.setting))

    def record(self) -> None:
        """Cut a window."""
        self.clock.now += PERIOD_S
        references = [1e-3 * (1 + self.agent.windows_cut % 2)] * int(PERIOD_S)
        letters = self.agent.absorb_block(references, references, references, references)
        for each in letters:
            self.outbox.put_letter(encode(each.message))

    def exchange(self, service: Service, steps: int = 10**6) -> None:
        """Send what is due, and take what the twin has for this edge, as the link process does."""
        sender = Sender(self.session, service)
        for _ in range(steps):
            if sender.step(self.clock()).wait_s > 0.0:
                break
        outgoing, service.outgoing = service.outgoing, []
        for message in outgoing:
            if isinstance(message, Resend):
                self.outbox.resend(message.asks_for)
            for letter in self.agent.receive(message):
                self.outbox.put_letter(encode(letter.message))

    def run(self, service: Service, windows: int) -> None:
        for _ in range(windows):
            self.record()
            self.exchange(service)
            self.exchange(service)  # receipts


@pytest.mark.slow
def test_after_a_restore_updates_of_the_live_boot_still_arrive(tmp_path):
    clock = Clock()
    edge = Edge(tmp_path / "outbox.sqlite", clock)
    service = Service(twin_of(known_gap, Rule()), clock)
    edge.run(service, 5)
    assert edge.agent.parameters.version >= 3
    backup = Service(deepcopy(service.twin), clock)
    edge.restart("between")
    edge.run(service, BETWEEN)
    edge.restart("live")
    edge.run(service, 5)
    version = edge.agent.parameters.version
    assert version > 100

    # So quickly that the edge does not notice: it says no hello by itself.
    backup.outgoing.append(Resend("axis", reason="the twin's store was restored from a backup"))
    edge.exchange(backup)
    assert len(edge.outbox.pending()) == BETWEEN + 10
    edge.exchange(backup, steps=60)
    assert backup.order[:2] == ["", "backup"]
    edge.record()
    backup.order.clear()
    edge.exchange(backup)
    assert backup.order[0] == "live"
    edge.run(backup, 15)

    assert not edge.outbox.pending()
    assert [what for what in edge.session.counts if "future" in what] == []
    log = backup.twin.log
    assert sum(window.boot == "between" for window in log.windows.values()) == BETWEEN
    versions = decode_state("axis", backup.twin.state()).versions
    assert (versions.boot, versions.ended_boots) == ("live", ("backup",))
    basis = edge.agent.parameters.window
    assert basis is not None
    assert basis == ("live", edge.agent.windows_cut - 1)
    assert edge.agent.parameters.version > version
    edge.outbox.close()
