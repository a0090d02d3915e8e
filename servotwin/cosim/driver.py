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

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.cosim.loop import Loop, Transmission
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.probe import ProbingMove
from servotwin.edge.recorder import Floats
from servotwin.link.outbox import MemoryOutbox
from servotwin.link.simulated import SimulatedLink
from servotwin.messages import Answer, Fallback, Message, Receipt, Request, Setting, Update, decode, encode
from servotwin.plant.signals import PiecewiseCubic, as_pieces
from servotwin.runtime.clock import Event, VirtualClock
from servotwin.simulation import Run
from servotwin.simulation.inputs import shifted
from servotwin.twin.estimating import Estimator
from servotwin.twin.evidence import EvidenceLog
from servotwin.twin.model import TwinModel
from servotwin.twin.twin import Twin

Progress = Callable[[float], object]
"""Callback with the completed share, 0 .. 1."""

CHANNELS = ("reference", "theta_m", "position", "voltage")
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
    machine = simulation_of(scenario)
    cosimulation = Cosimulation(scenario, machine, estimator)
    while not cosimulation.done:
        cosimulation.advance()
        if progress is not None:
            progress(cosimulation.share)
    return cosimulation.loop(machine.run())


class Machine(Protocol):
    """Controlled machine with its controller: a `Simulation`, or a stub in a test."""

    samples: int

    @property
    def index(self) -> int:
        """Number of the present sample."""

    def advance(self, index: int) -> None:
        """Advance to a sample."""

    def measured(self, name: str, first: int, last: int) -> Floats:
        """Return a channel at samples first .. last - 1, all before the present one."""

    def set_tolerance(self, tolerance: float) -> None:
        """Set the dead zone (m) from the present sample on."""

    def set_reference(self, reference: PiecewiseCubic) -> None:
        """Set the reference (m) from the present sample on."""

    def set_controller(self, controller: Controller, tolerance: float) -> None:
        """Set controller and dead zone (m) from the present sample on; the voltage does not jump."""


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
        self.outbox = MemoryOutbox()
        self.agent = Agent(scenario.agent_settings(), self.outbox)
        self.store = EvidenceLog()
        start = Setting(scenario.start_tolerance, gains_of(scenario.start_law))
        self.twin = twin or Twin(
            scenario.name, TwinModel.of(scenario.model, scenario.twin, start, estimator), self.store
        )
        self.link = SimulatedLink(
            scenario.name,
            self.clock,
            self._at_twin,
            self._at_edge,
            scenario.uplink,
            scenario.downlink,
            scenario.seed,
        )
        self.receipts: list[Receipt] = []
        self.fallbacks: list[Fallback] = []
        self.answers: list[Answer] = []
        self._in_force = self.agent.parameters
        self._reference = as_pieces(scenario.reference, scenario.duration)
        self._probe: ProbingMove | None = None
        self._wake: Event | None = None

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
        first, stop = self.machine.index, self._next_stop()
        self.machine.advance(stop)
        blocks = (self.machine.measured(name, first, stop) for name in CHANNELS)
        sent = self.agent.absorb_block(*blocks)
        self._follow()
        for outgoing in sent:
            time = outgoing.sample / self.scenario.recording.sample_rate
            self.clock.schedule(max(time, self.clock.now), partial(self._send_up, outgoing))
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
            receipts=tuple(self.receipts),
            fallbacks=tuple(self.fallbacks),
            excitations=tuple(self.store.excitations.values()),
            requests=tuple(self.store.requests),
            answers=tuple(self.answers),
            messages=tuple(sorted(self._transmissions(), key=lambda m: (m.sent, m.direction, m.serial, m.copy))),
            accounts=self._accounts(),
        )

    def _next_stop(self) -> int:
        """Sample up to which nothing can happen to the machine (see the module)."""
        index = self.machine.index
        stops = [index + self.agent.shortest_wait, self.machine.samples - 1]
        if self.clock.next_time is not None:
            stops.append(self._sample_at(self.clock.next_time))
        if self.agent.deadline is not None:
            stops.append(self.agent.deadline)
        return max(min(stops) if self._probe is None else self._before_moving(min(stops)), index + 1)

    def _before_moving(self, stop: int) -> int:
        """Sample at which the reference first changes, at most `stop`."""
        first = self.machine.index - 1
        references = self._reference.on(np.arange(first, stop) / self.scenario.recording.sample_rate)
        moved = np.flatnonzero(references != references[0])
        return first + int(moved[0]) + 1 if moved.size else stop

    def _sample_at(self, time: float) -> int:
        """First sample at or after a time."""
        return math.ceil(time * self.scenario.recording.sample_rate - _ROUNDING)

    def _send_up(self, outgoing: ScheduledMessage) -> None:
        if isinstance(outgoing.message, Receipt):
            self.receipts.append(outgoing.message)
        elif isinstance(outgoing.message, Fallback):
            self.fallbacks.append(outgoing.message)
        elif isinstance(outgoing.message, Answer):
            self.answers.append(outgoing.message)
        self.link.up.send(encode(outgoing.message))

    def _at_edge(self, data: bytes) -> None:
        """Receive bytes at the edge."""
        sent = self.agent.receive(decode(data))
        self._follow()
        for outgoing in sent:
            self._send_up(outgoing)

    def _follow(self) -> None:
        """Apply the agent's parameters and probing move to the machine."""
        self._retune()
        if self.agent.probe is not self._probe:
            self._probe = self.agent.probe
            self.machine.set_reference(self._reference if self._probe is None else self._moved(self._probe))

    def _moved(self, move: ProbingMove) -> PiecewiseCubic:
        """Reference with a probing move added."""
        changes = [(0, 0.0), *move.changes(), (move.last, 0.0)]
        times = [sample / self.scenario.recording.sample_rate for sample, _ in changes]
        return shifted(self._reference, PiecewiseCubic.held(times, [offset for _, offset in changes]))

    def _retune(self) -> None:
        """Apply the parameters in force to the machine where they have changed."""
        parameters, controller = self.agent.parameters, self.agent.controller
        if parameters is self._in_force:
            return
        self._in_force = parameters
        if controller is None:
            self.machine.set_tolerance(parameters.setting.tolerance)
        else:
            self.machine.set_controller(controller, parameters.setting.tolerance)

    def _at_twin(self, data: bytes) -> None:
        """Receive bytes at the twin; a twin that is switched off ignores them."""
        if self.scenario.twin.enabled:
            self._answer(self.twin.receive(decode(data), self.clock.now))

    def _wake_twin(self) -> None:
        self._wake = None
        self._answer(self.twin.wake(self.clock.now))

    def _answer(self, messages: Iterable[Message]) -> None:
        """Send the twin's messages, updates after its processing time, and schedule its next wake."""
        for message in messages:
            delay = self.scenario.twin.processing if isinstance(message, Update | Request) else 0.0
            self.clock.schedule(self.clock.now + delay, partial(self.link.down.send, encode(message)))
        if self._wake is not None:
            self.clock.cancel(self._wake)
        due = self.twin.next_wake()
        self._wake = None if due is None else self.clock.schedule(max(due, self.clock.now), self._wake_twin)

    def _transmissions(self) -> Iterable[Transmission]:
        for direction, line in (("up", self.link.up), ("down", self.link.down)):
            for r in line.records:
                yield Transmission(direction, r.serial, r.copy, r.data, r.sent, r.arrival, r.fate)

    def _accounts(self) -> Counter[str]:
        delivered = {(boot, sequence) for _, boot, sequence in self.store.windows}
        waiting = [key for key in self.outbox.pending() if key not in delivered]
        counts = Counter({"delivered": len(delivered), "in flight": len(waiting)})
        return +(counts + self.agent.dropped)
