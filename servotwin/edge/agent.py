"""The edge's agent: samples and messages in, messages out; its clock is sample time.

It records, cuts a window after each change of the reference, repeats it until the twin acknowledges it, and lets its
supervisor decide about parameters. It does not control: whoever ticks the law asks `parameters` before each sample, or
`controller` where updates may set gains, and carries its state over by `servotwin.control.law.transfer`.
"""

from array import array
from collections import Counter
from itertools import chain, pairwise
from math import ceil, inf
from typing import NamedTuple

from servotwin.control.controller import Controller
from servotwin.edge.parameters import Parameters, with_gains
from servotwin.edge.recorder import Floats, Recorder, as_floats
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import Store
from servotwin.edge.supervisor import Supervisor
from servotwin.errors import InvalidInput
from servotwin.link.outbox import MemoryOutbox, Outbox
from servotwin.link.session import Sender
from servotwin.messages import (
    Acknowledge,
    Channel,
    Hello,
    InvalidMessage,
    Message,
    Update,
    Window,
    checksum,
    pack_channel,
    pack_finely,
)

CHANNELS = {"reference": "m", "theta_m": "rad", "position": "m", "voltage": "V"}
"""What is recorded, in this order, with units."""

MAX_CHANGES = 256
"""Reference changes listed per window; the reference channel has them all."""


class Outgoing(NamedTuple):
    """A message and the sample instant (samples absorbed so far) at which it leaves."""

    sample: int
    message: Message


class Agent:
    """Records, sends and guards for one servo.

    A change of the reference opens a window; changes before it is complete are listed in it and open none of their
    own, so windows never overlap and a reference in steady motion gives one window after the other. A window that holds
    a sample which is not finite is dropped and counted.

    Parameters
    ----------
    settings : AgentSettings
    outbox : Outbox, optional
        In memory by default.
    store : Store, optional
        Of the last parameters that were proved; without one each boot begins as configured.
    """

    def __init__(self, settings: AgentSettings, outbox: Outbox | None = None, store: Store | None = None) -> None:
        self.settings = settings
        self.outbox = MemoryOutbox() if outbox is None else outbox
        self.windows_cut = 0
        self._sender = Sender(self.outbox, settings.retry)
        self._recorder = Recorder(tuple(CHANNELS), max(settings.window_samples + 1, settings.period_samples))
        self._supervisor = Supervisor(settings, self._recorder, store)
        if self.outbox.pending():
            self._supervisor.asked(0.0)
        self._reference = settings.reference
        self._first: int | None = None
        self._unusable: Counter[str] = Counter()
        self._deadline = self._next_deadline()

    @property
    def parameters(self) -> Parameters:
        """In force from the next sample on."""
        return self._supervisor.parameters

    @property
    def controller(self) -> Controller | None:
        """The controller with the gains in force; None where updates set the tolerance only."""
        configured = self.settings.controller
        return None if configured is None else with_gains(configured, self.parameters.gains)

    @property
    def samples(self) -> int:
        """Samples absorbed so far: the index of the next one."""
        return self._recorder.samples

    @property
    def time(self) -> float:
        """Sample time of the next sample, s."""
        return self.samples / self.settings.sample_rate

    @property
    def deadline(self) -> int | None:
        """`samples` at which it will send something by itself if the reference rests; None: never."""
        return None if self._deadline == inf else int(self._deadline)

    @property
    def dropped(self) -> Counter[str]:
        """Windows that will never be sent again without having been acknowledged, by reason."""
        return self._unusable + Counter(self.outbox.dropped)

    def absorb(self, reference: float, theta_m: float, position: float, voltage: float) -> list[Outgoing]:
        """Take one sample (m, rad, m, V); returns what is to be sent now."""
        self._recorder.append(reference, theta_m, position, voltage)
        if reference != self._reference:
            self._reference_changed(reference)
        return self._act() if self._recorder.samples >= self._deadline else []

    def absorb_block(self, reference: Floats, theta_m: Floats, position: Floats, voltage: Floats) -> list[Outgoing]:
        """Take equally long blocks of samples: the same effect as one by one."""
        blocks = [as_floats(block) for block in (reference, theta_m, position, voltage)]
        if len({len(block) for block in blocks}) != 1:
            raise InvalidInput(f"blocks of {[len(block) for block in blocks]} samples: must be equally long")
        sent: list[Outgoing] = []
        done = 0
        while done < len(blocks[0]):
            stop = self._stop(blocks[0], done)
            self._recorder.extend(*(block[done:stop] for block in blocks))
            if blocks[0][stop - 1] != self._reference:
                self._reference_changed(blocks[0][stop - 1])
            if self.samples >= self._deadline:
                sent += self._act()
            done = stop
        return sent

    def receive(self, message: Message) -> list[Outgoing]:
        """Take a message from the twin; returns what is to be sent now. Messages not meant for an edge are ignored."""
        if isinstance(message, Update):
            said = self._supervisor.offer(message)
            self._heard(message.servo)
            return [Outgoing(self.samples, each) for each in said]
        if isinstance(message, Acknowledge) and message.servo == self.settings.servo:
            self._sender.acknowledged(message)
            self._heard(message.servo)
        return []

    def hello(self) -> Hello:
        """Who this is and what is in force: to be sent after a start or a reconnection."""
        s, p = self.settings, self.parameters
        return Hello(s.servo, s.boot, self.time, s.sample_rate, p.version, p.tolerance, s.model_version)

    def _stop(self, reference: "array[float]", done: int) -> int:
        """Where in a block the next thing may happen: its end, the deadline, just after a change of the reference."""
        stop = int(min(len(reference), done + self._deadline - self.samples))
        if self._first is not None:
            return stop
        last = self._reference
        return next((k + 1 for k in range(done, stop) if reference[k] != last), stop)

    def _heard(self, servo: str) -> None:
        """The twin said something."""
        if servo == self.settings.servo:
            self._supervisor.answered(self.time, more=bool(self.outbox.pending()))
        self._deadline = self._next_deadline()

    def _reference_changed(self, reference: float) -> None:
        """The sample just absorbed brought a new reference."""
        self._reference = reference
        if self._first is None:
            self._first = max(0, self.samples - 1 - self.settings.pre_trigger_samples)
            self._deadline = self._next_deadline()

    def _act(self) -> list[Outgoing]:
        """Cut the window that is complete, and send what is due."""
        if self._first is not None and self.samples >= self._first + self.settings.window_samples:
            self._cut(self._first, "reference")
            self._first = None
        sent = [Outgoing(self.samples, window) for window in self._sender.due(self.time)]
        sent += [Outgoing(self.samples, said) for said in self._supervisor.look()]
        self._deadline = self._next_deadline()
        return sent

    def _cut(self, first: int, reason: str) -> None:
        sequence, self.windows_cut = self.windows_cut, self.windows_cut + 1
        try:
            window = self._window(first, sequence, reason)
        except InvalidMessage:
            self._unusable["sample not finite"] += 1
        else:
            self._sender.offer(window, self.time)
            self._supervisor.asked(self.time)

    def _window(self, first: int, sequence: int, reason: str) -> Window:
        signals = self._recorder.cut(first, first + self.settings.window_samples)
        channels = tuple(chain.from_iterable(self._packed(name, values) for name, values in signals.items()))
        return Window(
            servo=self.settings.servo,
            boot=self.settings.boot,
            sequence=sequence,
            start=first / self.settings.sample_rate,
            rate=self.settings.sample_rate,
            channels=channels,
            reference_changes=self._changes(first, signals["reference"]),
            parameter_version=self.parameters.version,
            model_version=self.settings.model_version,
            reason=reason,
            crc=checksum(channels),
        )

    def _packed(self, name: str, values: "array[float]") -> tuple[Channel, ...]:
        if self.settings.fine_angle and name == "theta_m":
            return pack_finely(name, CHANNELS[name], values)
        return (pack_channel(name, CHANNELS[name], values),)

    def _changes(self, first: int, reference: "array[float]") -> tuple[tuple[float, float], ...]:
        """(time, new value) of the first changes inside a window."""
        before = self._recorder.cut(first - 1, first)["reference"][0] if first > 0 else self.settings.reference
        steps = enumerate(pairwise((before, *reference)), first)
        changes = [(index / self.settings.sample_rate, new) for index, (old, new) in steps if new != old]
        return tuple(changes[:MAX_CHANGES])

    def _next_deadline(self) -> float:
        """`samples` at which to act again, always in the future or now complete; inf: nothing to wait for."""
        wanted = self._supervisor.next_look
        if self._first is not None:
            wanted = min(wanted, self._first + self.settings.window_samples)
        due = self._sender.next_time
        if due is None:
            return wanted
        return min(wanted, max(self.samples + 1, ceil(max(due, 0.0) * self.settings.sample_rate)))
