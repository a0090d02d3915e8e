"""The edge's agent: samples and messages in, messages out; its clock is sample time.

It records, cuts a window after each change of the reference, hands it to its outlet, and lets its supervisor decide
about parameters. It returns letters, which its caller sends through the same outbox as the windows.

It does not control: the caller ticks the law. Before each sample the caller reads `parameters`, or `controller` where
updates may set gains, and transfers the law's state by `servotwin.control.law.transfer`. It adds `offset` to the
reference; the offset is zero except during a probing move that the twin has requested and the edge's settings allow.
Such a move begins while the reference rests, and ends by itself, or at once when the reference moves.
"""

from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

from servotwin.control.gains import gains_of, with_gains
from servotwin.control.laws import AnyController
from servotwin.edge.guard import Instant
from servotwin.edge.outlet import LocalOutlet, Outlet, recorded_channels
from servotwin.edge.parameters import Parameters
from servotwin.edge.probe import ProbingMove
from servotwin.edge.recorder import TIMED, Cut, Floats, Recorder, as_floats
from servotwin.edge.requests import GrantedRequests, decide
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import ParameterStore
from servotwin.edge.supervisor import Supervisor
from servotwin.errors import InvalidInput
from servotwin.link.outbox import Outbox
from servotwin.messages import (
    PROTOCOL,
    Acknowledge,
    Fallback,
    Hello,
    LearntResponse,
    Message,
    Request,
    Resend,
    Setting,
    Update,
)


class ScheduledMessage(NamedTuple):
    """A letter, and the sample instant (samples absorbed so far) at which it is sent."""

    sample: int
    message: Message


class _OpenWindow(NamedTuple):
    """A window that is being recorded, samples first .. last - 1, and its reason."""

    first: int
    last: int
    reason: str


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
    store : ParameterStore, optional
        Stores the last parameters under which the loop kept its band; without one each boot begins as configured.
    outlet : Outlet, optional
        Takes the cut windows; by default they are put into `outbox`.
    recorder : callable, optional
        Makes the ring buffer from names and capacity.
    """

    def __init__(
        self,
        settings: AgentSettings,
        outbox: Outbox | None = None,
        store: ParameterStore | None = None,
        outlet: Outlet | None = None,
        recorder: Callable[[Sequence[str], int], Recorder] = Recorder,
    ) -> None:
        self.settings = settings
        self.windows_cut = 0
        self.outlet = LocalOutlet(settings, outbox) if outlet is None else outlet
        self._recorder = recorder(recorded_channels(settings.motor_encoder), settings.kept_samples)
        self._supervisor = Supervisor(settings, self._recorder, store)
        if self.outlet.unacknowledged:
            self._supervisor.window_sent(0.0)
        self._requests = GrantedRequests(settings.window_samples, settings.pre_trigger_samples)
        self._reference = self._expected = settings.reference
        self._open_window: _OpenWindow | None = None
        self._cut_at = 0
        self._deadline = self._next_deadline()

    @property
    def parameters(self) -> Parameters:
        """Parameters in force from the next sample on."""
        return self._supervisor.parameters

    @property
    def controller(self) -> AnyController | None:
        """The controller with the gains in force; None where updates set the tolerance only."""
        configured = self.settings.controller
        return None if configured is None else with_gains(configured, self.parameters.setting.gains)

    @property
    def probe(self) -> ProbingMove | None:
        """The probing move under way."""
        return self._requests.probe

    @property
    def offset(self) -> float:
        """Offset to be added to the reference of the next sample, m."""
        return 0.0 if self.probe is None else self.probe.offset(self.samples)

    @property
    def shortest_wait(self) -> int:
        """Samples from a change of the reference to the end of its window."""
        return self._requests.window - self._requests.pre_trigger

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
        """Value of `samples` at which it acts by itself while the reference rests; None: never."""
        return None if self._deadline == inf else int(self._deadline)

    @property
    def dropped(self) -> Counter[str]:
        """Number of windows dropped without an acknowledgement, by reason."""
        return Counter(self.outlet.dropped)

    def absorb(self, reference: float, theta_m: float, position: float, voltage: float) -> list[ScheduledMessage]:
        """Take one sample (m, rad, m, V); return the letters to be sent now.

        Without an encoder of the motor its angle does not count, here and in blocks.
        """
        if self.settings.motor_encoder:
            self._recorder.append(reference, theta_m, position, voltage)
        else:
            self._recorder.append(reference, position, voltage)
        if reference != self._expected:
            self._reference_changed(reference)
        return self._act() if self._recorder.samples >= self._deadline else []

    def absorb_block(
        self, reference: Floats, theta_m: Floats, position: Floats, voltage: Floats
    ) -> list[ScheduledMessage]:
        """Take equally long blocks of samples: the same effect as one by one."""
        motor = (theta_m,) if self.settings.motor_encoder else ()
        blocks = [as_floats(block) for block in (reference, *motor, position, voltage)]
        if len({len(block) for block in blocks}) != 1:
            raise InvalidInput(f"blocks of {[len(block) for block in blocks]} samples: must be equally long")
        sent: list[ScheduledMessage] = []
        done = 0
        while done < len(blocks[0]):
            stop = self._stop(blocks[0], done)
            self._recorder.extend(*(block[done:stop] for block in blocks))
            if blocks[0][stop - 1] != self._expected:
                self._reference_changed(blocks[0][stop - 1])
            if self.samples >= self._deadline:
                sent += self._act()
            done = stop
        return sent

    def receive(self, message: Message) -> list[ScheduledMessage]:
        """Take a message from the twin; return the letters to be sent now. Messages not for an edge are ignored."""
        if isinstance(message, Update):
            replies = self._supervisor.offer(message)
            self._twin_answered(message.servo)
            return [ScheduledMessage(self.samples, each) for each in replies]
        if isinstance(message, Request):
            return self._handle_request(message)
        if isinstance(message, LearntResponse) and message.servo == self.settings.servo:
            self.outlet.adopt(message)
        if isinstance(message, Acknowledge) and message.servo == self.settings.servo:
            self._twin_answered(message.servo)
        if isinstance(message, Resend) and message.servo == self.settings.servo and message.boot is None:
            # The twin may not know this boot, and cannot tell it from those that have ended meanwhile.
            return [ScheduledMessage(self.samples, self.hello())]
        return []

    def outlet_changed(self) -> None:
        """Note that the outlet's unacknowledged windows have changed by themselves."""
        if self.outlet.unacknowledged:
            self._supervisor.window_sent(self.time)
        else:
            self._supervisor.twin_answered(self.time, more=False)
        self._deadline = self._next_deadline()

    def restore(self, former: Parameters) -> list[ScheduledMessage]:
        """Put former parameters in force again, since the drive has refused the present ones; return messages."""
        messages = self._supervisor.restore(former)
        self._deadline = self._next_deadline()
        return [ScheduledMessage(self.samples, each) for each in messages]

    def superseded(self) -> list[ScheduledMessage]:
        """Fall back, since another edge of the servo has taken over; return messages."""
        messages = self._supervisor.superseded()
        self._deadline = self._next_deadline()
        return [ScheduledMessage(self.samples, each) for each in messages]

    def hello(self) -> Hello:
        """Make the message that introduces the edge: send it after a start or a reconnection."""
        s, p, law = self.settings, self.parameters, self.controller
        # The gains in force, which an earlier boot may have stored, and not the configured ones.
        setting = Setting.of(p.setting.tolerance, None if law is None else gains_of(law))
        return Hello(s.servo, s.boot, self.time, s.sample_rate, p.version, setting, s.model_version, PROTOCOL)

    def _stop(self, reference: "array[float]", done: int) -> int:
        """End of the part of a block in which nothing happens: the deadline, or after a change of the reference."""
        stop = int(min(len(reference), done + self._deadline - self.samples))
        # Changes within an open window are listed when it is cut, so the block goes on; a probing move ends at one.
        if self._open_window is not None and self.probe is None:
            return stop
        last = self._expected
        return next((k + 1 for k in range(done, stop) if reference[k] != last), stop)

    def _twin_answered(self, servo: str) -> None:
        """Note an answer of the twin's."""
        if servo == self.settings.servo:
            self._supervisor.twin_answered(self.time, more=self.outlet.unacknowledged)
        self._deadline = self._next_deadline()

    def _handle_request(self, request: Request) -> list[ScheduledMessage]:
        """Decide about a request; a probing move begins with the next sample."""
        s, before = self.settings, self.probe
        here = Instant(s.servo, s.boot, self.samples, s.sample_rate)
        self._requests, answer = decide(request, self._requests, s, here, self._at_rest())
        move = self.probe
        if move is not None and move is not before:
            self._open_window = _OpenWindow(max(0, move.first - self._requests.pre_trigger), move.last, move.reason)
            self._expected = self._reference + self.offset
        self._twin_answered(request.servo)
        return [ScheduledMessage(self.samples, answer)]

    def _at_rest(self) -> bool:
        """True where the reference rests and no window is being recorded."""
        return (
            self._open_window is None
            and self._recorder.constant("reference", self.settings.rest_samples) == self._reference
        )

    def _reference_changed(self, reference: float) -> None:
        """Note the new reference in the last sample, and abort a probing move."""
        self._reference = reference
        self._abort()
        if self._open_window is None:
            first = max(0, self.samples - 1 - self._requests.pre_trigger)
            self._open_window = _OpenWindow(first, first + self._requests.window, "reference")
            self._deadline = self._next_deadline()

    def _abort(self) -> None:
        """End the probing move and its window."""
        if self.probe is not None:
            self._requests = replace(self._requests, probe=None)
            self._open_window = None
        self._expected = self._reference

    def _act(self) -> list[ScheduledMessage]:
        """Cut the window that is complete, and return the supervisor's letters."""
        opened = self._open_window
        if opened is not None and self.samples >= opened.last:
            self._cut(opened)
            self._abort()
            self._open_window = None
        elif opened is None and self.samples >= self._timed:
            self._cut(_OpenWindow(self.samples - self._requests.window, self.samples, TIMED))
        messages = self._supervisor.check()
        if any(isinstance(each, Fallback) for each in messages):
            self._abort()
        self._expected = self._reference + self.offset
        self._deadline = self._next_deadline()
        return [ScheduledMessage(self.samples, each) for each in messages]

    def _cut(self, opened: _OpenWindow) -> None:
        """Cut a window and hand it to the outlet."""
        sequence, self.windows_cut = self.windows_cut, self.windows_cut + 1
        self._cut_at = self.samples
        self.outlet.offer(self._cut_samples(opened, sequence))
        if self.outlet.unacknowledged:  # not so where the filter kept the window back
            self._supervisor.window_sent(self.time)

    def _cut_samples(self, opened: _OpenWindow, sequence: int) -> Cut:
        """Copy the samples, and note the parameters in force."""
        p, signals = self.parameters, self._recorder.cut(opened.first, opened.last)
        basis = p.window[1] if p.window is not None and p.window[0] == self.settings.boot else None
        return Cut(opened.first, sequence, opened.reason, p.version, self._before(opened.first), signals, p.gap, basis)

    @property
    def _timed(self) -> float:
        """Value of `samples` at which a window is cut although the reference rests."""
        # At least a window after the last one, so that two windows share no sample.
        return self._cut_at + max(self.settings.look_samples, self._requests.window)

    def _before(self, first: int) -> float:
        """Reference just before a sample, m."""
        return self._recorder.cut(first - 1, first)["reference"][0] if first > 0 else self.settings.reference

    def _next_deadline(self) -> float:
        """Value of `samples` at which to act again; inf: there is nothing to wait for."""
        deadline = self._supervisor.next_check
        deadline = min(deadline, self._timed if self._open_window is None else self._open_window.last)
        if self.probe is not None:
            deadline = min(deadline, self.probe.next_change(self.samples))
        return deadline
