"""A worker's job for one servo: a lease in; next state, evidence and messages out.

A pure function of bytes: equal leases give equal results, in whichever process and however often, so that committing a
result once makes every effect happen once. Nothing that a message holds, or does to the twin, raises: it becomes
evidence whose status begins with "failed", and the next message finds the twin as the one before left it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, Message, WindowMessage
from servotwin.messages.compression import decompress
from servotwin.store.records import EvidenceRecord, Incoming, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.context import context_of
from servotwin.twin.evidence import failure_row, rows
from servotwin.twin.lookups import VerificationRequest, decode_request, encode_request
from servotwin.twin.model import TwinModel
from servotwin.twin.model_registry import ModelRegistry, ServoModel
from servotwin.twin.state import TwinState, encode_state
from servotwin.twin.step import Event, Wake, WindowArrival, next_wake, step

ONE_BY_ONE, GIVEN_UP = 3, 5
"""Attempts of one lease from which on it is worked through message by message, so that the one that kills its workers
is found; and from which on that one is given up."""


def work(registry: ModelRegistry, lease: Lease, now: float) -> WorkResult:
    """Process a lease.

    Parameters
    ----------
    registry : ModelRegistry
    lease : Lease
        Of a servo that the registry does not know, every message fails.
    now : float
        s since the epoch; in lock-step, sample time. It may jump: nothing is waited for longer than from `now` on.
    """
    taken = lease.messages[:1] if lease.attempts >= ONE_BY_ONE else lease.messages
    try:
        return _Worker(registry.model_of(lease.servo), lease).result(taken, now)
    except InvalidInput as error:
        evidence = tuple(failure_row(stored.id, str(error)) for stored in taken)
        return WorkResult(lease.servo, lease.serial, lease.state, None, tuple(stored.id for stored in taken), evidence)


class _Worker:
    """State and results of one servo's twin for the length of one lease."""

    def __init__(self, model: ServoModel, lease: Lease) -> None:
        self.servo_model, self.lease = model, lease
        self.context = context_of(model.servo, model.settings)
        self.evidence: list[EvidenceRecord] = []
        self.unverified: list[VerificationRequest] = []
        self.sent: list[Message] = []
        self.model, self.state = self._restored()

    def result(self, taken: Sequence[StoredMessage], now: float) -> WorkResult:
        """After these messages, and what is overdue."""
        given_up = self.lease.attempts >= GIVEN_UP
        for stored in taken:
            if given_up:
                why = f"given up, as {self.lease.attempts - 1} workers died of it"
                self.evidence.append(failure_row(stored.id, why))
            else:
                self._process(stored, now)
        # A lease that kills its workers without a message is not woken again before the next message.
        woken = not (given_up and not taken) and self._step(0, Wake(), now)
        return WorkResult(
            self.lease.servo,
            self.lease.serial,
            encode_state(self.state),
            next_wake(self.model, self.state) if woken else None,
            tuple(stored.id for stored in taken),
            tuple(self.evidence),
            tuple(messages.encode(message) for message in self.sent),
            enqueue=tuple(_queued(request, now) for request in self.unverified),
            contexts=(self.context,) if any(row.context for row in self.evidence) else (),
        )

    def _restored(self) -> tuple[TwinModel, TwinState]:
        """The twin as the last result left it. One whose state cannot be read begins anew, the old state stored with
        the reason: version numbers and boots come back with the edge's next message."""
        servo, data = self.lease.servo, self.lease.state
        if data:
            model = self.servo_model.twin(restored=True)
            try:
                return model, model.restored(servo, data)
            except InvalidInput as error:
                self.evidence.append(failure_row(0, f"{error}; the twin begins anew", {"state": data}))
        model = self.servo_model.twin(restored=False)
        return model, model.initial_state(servo)

    def _process(self, stored: StoredMessage, now: float) -> None:
        """Decode a message and step; a twin that is switched off does nothing."""
        try:
            event = _event(stored)
            if not self.model.settings.enabled:
                return
        except Exception as error:
            self.evidence.append(failure_row(stored.id, f"{type(error).__name__}: {error}"))
            return
        self._step(stored.id, event, now)

    def _step(self, message: int, event: Event, now: float) -> bool:
        """Step; where anything goes wrong, it is as if there had been no event, and False."""
        try:
            result = step(self.model, self.state, event, now)
            found = rows(result.evidence, message, self.context[0])
        except Exception as error:
            self.evidence.append(failure_row(message, f"{type(error).__name__}: {error}"))
            return False
        self.state = result.state
        self.evidence += found
        self.unverified += [record for record in result.evidence if isinstance(record, VerificationRequest)]
        self.sent += result.messages
        return True


def _event(stored: StoredMessage) -> Event:
    """Decode a stored message.

    Raises
    ------
    InvalidMessage, InvalidInput
        The body is not understood, or nothing for a twin.
    """
    if stored.kind is MessageKind.VERIFICATION:
        return decode_request(stored.body)
    message = messages.decode(decompress(stored.body, stored.encoding, MAX_BYTES))
    return WindowArrival(message, stored.received) if isinstance(message, WindowMessage) else message


def _queued(request: VerificationRequest, now: float) -> Incoming:
    """A verification on the queue."""
    body = encode_request(request)
    digest = hashlib.sha256(body).digest()
    return Incoming(request.servo, MessageKind.VERIFICATION, digest.hex(), body, "", digest, now)
