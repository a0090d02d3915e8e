"""A worker's job for one servo: it turns a lease into the next state, evidence and messages.

A pure function of bytes: equal leases give equal results, in whichever process and however often, so that committing a
result once makes every effect happen once. Nothing that a message holds, or does to the twin, raises: it becomes
evidence whose status begins with "failed", and the next message finds the twin as the one before left it.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from msgspec.structs import replace

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, Hello, Message, WindowMessage
from servotwin.messages.acts import Act, ActKind, decode_act
from servotwin.messages.codec import decompress
from servotwin.store.records import (
    LONGEST_WAKE_S,
    TOO_LATE,
    EvidenceRecord,
    Incoming,
    Lease,
    MessageKind,
    StoredMessage,
    WorkResult,
)
from servotwin.twin.context import context_of
from servotwin.twin.evidence import ActRecord
from servotwin.twin.evidence_rows import failure_row, rows
from servotwin.twin.lookups import VerificationRequest, decode_request, encode_request
from servotwin.twin.model import TwinModel
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.oversight import Oversight
from servotwin.twin.state import TwinState, encode_state, oversight_within
from servotwin.twin.step import Event, Wake, WindowArrival, next_wake, step

ONE_BY_ONE, ABANDON_AFTER = 3, 5
"""Attempts of a lease from which on it is processed message by message, which isolates the message that kills its
workers; attempts from which on that message is abandoned."""

_LOST = "the twin's state could not be read: what an engineer had set before is lost, set it again"


@dataclass(frozen=True)
class Urgency:
    """Limits of a servo's work to what can still have an effect, where more arrives than can be worked off.

    Attributes
    ----------
    expected_s : float
        Time from the begin of the work until the edge has decided on the update.
    speed : float
        Least ratio of sample time to real time.
    others_wait : bool
        Overtaken windows are not estimated, because other servos wait.
    defer : bool
        A window for which a glance does not do is left for a lease that is for an estimate.
    """

    expected_s: float = 0.0
    speed: float = 1.0
    others_wait: bool = False
    defer: bool = False


def work(registry: ModelRegistry, lease: Lease, now: float, urgency: Urgency | None = None) -> WorkResult:
    """Process a lease.

    Parameters
    ----------
    registry : ModelRegistry
    lease : Lease
        Where the registry has no model of the servo, every message fails.
    now : float
        s since the epoch; in lock-step, sample time. It may jump: no wait becomes longer than one from `now`.
    urgency : Urgency, optional
        Only the newest window of the lease may change the setting, if that can still be in time, and receipts are
        processed first. None, as in lock-step: every window may, in order.
    """
    if urgency is not None and lease.estimate:
        urgency = dataclasses.replace(urgency, defer=False)
    batch = lease.messages[:1] if lease.attempts >= ONE_BY_ONE else lease.messages
    try:
        return _Worker(registry.model_of(lease.servo), lease, now).result(batch, now, urgency)
    except InvalidInput as error:
        evidence = tuple(failure_row(stored.id, str(error)) for stored in batch)
        done = tuple(stored.id for stored in batch)
        return WorkResult(lease.servo, lease.serial, lease.state, None, done, evidence, deferred=0)


class _Worker:
    """State and results of one servo's twin for the length of one lease."""

    def __init__(self, model: ServoModel, lease: Lease, now: float) -> None:
        self.servo_model, self.lease = model, lease
        self.context = context_of(model.servo, model.settings)
        self.evidence: list[EvidenceRecord] = []
        self.unverified: list[VerificationRequest] = []
        self.sent: list[Message] = []
        self.deferred = 0
        self.model, self.state = self._restored(now)

    def result(self, batch: Sequence[StoredMessage], now: float, urgency: Urgency | None) -> WorkResult:
        """Process the messages and whatever is overdue, and return the result."""
        abandoned = self.lease.attempts >= ABANDON_AFTER
        if abandoned:
            why = f"abandoned, because {self.lease.attempts - 1} workers died while they processed it"
            self.evidence += [failure_row(stored.id, why) for stored in batch]
        else:
            self._process(batch, now, urgency)
        # A lease without messages that kills its workers must wait for the next message, not kill one at each wake.
        woken = not (abandoned and not batch) and self._step(0, Wake(), now)
        return WorkResult(
            self.lease.servo,
            self.lease.serial,
            encode_state(self.state),
            self._next_wake(now) if woken else None,
            tuple(stored.id for stored in batch if stored.id != self.deferred),
            tuple(self.evidence),
            tuple(messages.encode(message) for message in self.sent),
            enqueue=tuple(_queued(request, now) for request in self.unverified),
            contexts=(self.context,) if any(row.context for row in self.evidence) else (),
            deferred=self.deferred if any(stored.kind is MessageKind.WINDOW for stored in batch) else None,
        )

    def _next_wake(self, now: float) -> float | None:
        """Time of the next wake-up, which may come before anything is due: the store doubts a later one."""
        due = next_wake(self.model, self.state)
        return None if due is None else min(due, now + LONGEST_WAKE_S)

    def _restored(self, now: float) -> tuple[TwinModel, TwinState]:
        """Restore the twin from the last result.

        Where the state cannot be read the twin begins anew, and the old state is stored with the reason. The edge's
        next message brings version number and boot back. What engineers have set stays where it can be read; otherwise
        its end is stored like an act, so that nobody relies on a hold that is lost.
        """
        servo, data = self.lease.servo, self.lease.state
        kept: Oversight | None = Oversight()
        if data:
            model = self.servo_model.twin(restored=True)
            try:
                return model, model.restored(servo, data)
            except InvalidInput as error:
                self.evidence.append(failure_row(0, f"{error}; the twin begins anew", {"state": data}))
            kept = oversight_within(servo, data)
            if kept is None:
                ended = (ActKind.RELEASE, ActKind.ASK_NO_MORE)
                self._note(0, *(ActRecord(Act(servo, kind, "servotwin", _LOST, now), "") for kind in ended))
        model = self.servo_model.twin(restored=False)
        return model, replace(model.initial_state(servo), oversight=kept or Oversight())

    def _process(self, batch: Sequence[StoredMessage], now: float, urgency: Urgency | None) -> None:
        """Decode the messages and step; a twin that is switched off does nothing."""
        if urgency is None:
            decoded: Iterator[tuple[int, Event]] = self._decoded(batch)
        else:
            events = list(self._decoded(batch))
            decoded = iter(_urgent(events, self.state, self.model.settings.valid_for, now, urgency))
        for message, event in decoded:
            # Acts are kept although the twin is switched off, but for the one that sends something.
            if not self.model.settings.enabled:
                if not isinstance(event, Act):
                    continue
                if event.act is ActKind.APPROVE:
                    self._note(message, ActRecord(event, "the twin of this servo is switched off"))
                    continue
            if urgency is not None and isinstance(event, WindowArrival) and self.state.has_overtaken(event.window):
                event = event._replace(overtaken=True, unseen=urgency.others_wait, deferrable=False)
            self._step(message, event, now)

    def _decoded(self, batch: Sequence[StoredMessage]) -> Iterator[tuple[int, Event]]:
        """Id and event of each message; one that cannot be decoded becomes evidence."""
        for stored in batch:
            try:
                yield stored.id, _event(stored)
            except Exception as error:
                self.evidence.append(failure_row(stored.id, f"{type(error).__name__}: {error}"))

    def _note(self, message: int, *records: ActRecord) -> None:
        self.evidence += rows(records, message, self.context[0])

    def _step(self, message: int, event: Event, now: float) -> bool:
        """Step; after an error the state is as before the event, and the result is False."""
        try:
            result = step(self.model, self.state, event, now)
            evidence = rows(result.evidence, message, self.context[0])
            if isinstance(event, WindowArrival) and event.overtaken:
                evidence = [row._replace(overtaken=True) for row in evidence]
        except Exception as error:
            self.evidence.append(failure_row(message, f"{type(error).__name__}: {error}"))
            return False
        self.deferred = message if result.deferred else self.deferred
        self.state = result.state
        self.evidence += evidence
        self.unverified += [record for record in result.evidence if isinstance(record, VerificationRequest)]
        self.sent += result.messages
        return True


def _newest(events: Sequence[Event], state: TwinState) -> WindowArrival | None:
    """Newest window of the edge's current boot; None: there is none.

    Windows of ended boots may come last: the twin asks for them again after a restore.
    """
    hellos = [event.boot for event in events if isinstance(event, Hello) and not state.versions.has_ended(event.boot)]
    windows = [event for event in events if isinstance(event, WindowArrival)]
    if hellos:
        boot: str | None = hellos[-1]
    elif state.introduced:
        boot = state.versions.boot
    else:
        boot = next((e.window.boot for e in reversed(windows) if not state.versions.has_ended(e.window.boot)), None)
    current = (event for event in windows if event.window.boot == boot)
    return max(current, key=lambda event: event.window.start, default=None)


def _urgent(
    events: Sequence[tuple[int, Event]], state: TwinState, validity: float, now: float, urgency: Urgency
) -> list[tuple[int, Event]]:
    """Events with receipts and acts first; windows marked that are overtaken, come too late or may be deferred.

    An update then names the right base, and nothing is sent that an act forbids.
    """
    newest, done_at = _newest([event for _, event in events], state), 0.0
    if newest is not None:
        end = newest.window.start + (newest.window.samples - 1) / newest.window.rate
        done_at = end + urgency.speed * max(0.0, now + urgency.expected_s - newest.time)

    def marked(event: Event) -> Event:
        if not isinstance(event, WindowArrival):
            return event
        left = event.window.start + validity - done_at
        late = f"{TOO_LATE} by {-left:.3g} s: an update may be applied for {validity:g} s from the window's start"
        overtaken = event is not newest
        return event._replace(
            overtaken=overtaken,
            unseen=overtaken and urgency.others_wait,
            too_late="" if left > 0.0 else late,
            deferrable=urgency.defer and not overtaken,
        )

    # Stable: the order of the others stays.
    ordered = sorted(events, key=lambda each: not isinstance(each[1], (messages.Receipt, Act)))
    return [(message, marked(event)) for message, event in ordered]


def _event(stored: StoredMessage) -> Event:
    """Decode a stored message.

    Raises
    ------
    InvalidMessage, InvalidInput
        The body cannot be read, or is not for a twin.
    """
    if stored.kind is MessageKind.VERIFICATION:
        return decode_request(stored.body)
    if stored.kind is MessageKind.ACT:
        return decode_act(stored.body)
    message = messages.decode(decompress(stored.body, stored.encoding, MAX_BYTES))
    return WindowArrival(message, stored.received) if isinstance(message, WindowMessage) else message


def _queued(request: VerificationRequest, now: float) -> Incoming:
    """Make the queue's row of a verification."""
    body = encode_request(request)
    digest = hashlib.sha256(body).digest()
    return Incoming(request.servo, MessageKind.VERIFICATION, digest.hex(), body, "", digest, now)
