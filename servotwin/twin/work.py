"""What a worker does for a servo: its state and its messages in, its next state, evidence and letters out.

A pure function of bytes: equal claims give equal outcomes, in whichever process and however often, so that committing
an outcome once makes every effect happen once. Nothing that a message holds, or does to the twin, raises: it becomes
evidence whose status begins with "failed", and the next message finds the twin as the one before left it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, Message, Window
from servotwin.messages.compression import decompress
from servotwin.store.records import Incoming, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin.context import context_of
from servotwin.twin.evidence import Rows, failed
from servotwin.twin.fleet import Fleet, Model
from servotwin.twin.lookups import Question, decode_question, encode_question
from servotwin.twin.twin import Twin

ONE_BY_ONE, GIVEN_UP = 3, 5
"""Attempts of one claim from which on it is worked through message by message, so that the one that kills its workers
is found; and from which on that one is given up."""


def work(fleet: Fleet, claim: Lease, now: float) -> WorkResult:
    """What becomes of a claim.

    Parameters
    ----------
    fleet : Fleet
    claim : Lease
        Of a servo that the fleet does not know, every message fails.
    now : float
        s since the epoch; in lock-step, sample time. It may jump: what is waited for is waited for once more then, no
        longer than from `now` on.
    """
    taken = claim.messages[:1] if claim.attempts >= ONE_BY_ONE else claim.messages
    try:
        return _Worker(fleet.model_of(claim.servo), claim).outcome(taken, now)
    except InvalidInput as error:
        return _unchanged(claim, taken, str(error))


class _Worker:
    """One servo's twin for the length of one claim."""

    def __init__(self, model: Model, claim: Lease) -> None:
        self.model, self.claim = model, claim
        self.context = context_of(model.servo, model.settings)
        self.rows = Rows(self.context[0])
        self.sent: list[Message] = []
        self.twin = self._restored(claim.state)
        self.state = self.twin.state()

    def outcome(self, taken: Sequence[StoredMessage], now: float) -> WorkResult:
        """After these messages, and what is overdue."""
        given_up = self.claim.attempts >= GIVEN_UP
        for stored in taken:
            if given_up:
                self.rows.found.append(failed(stored.id, f"given up, as {self.claim.attempts - 1} workers died of it"))
            else:
                self._try(stored.id, partial(told, self.twin, stored, now))
        woken = not (given_up and not taken) and self._try(0, partial(self.twin.wake, now))
        return WorkResult(
            self.claim.servo,
            self.claim.serial,
            self.state,
            self.twin.next_wake() if woken else None,
            tuple(stored.id for stored in taken),
            tuple(self.rows.found),
            tuple(messages.encode(message) for message in self.sent),
            enqueue=tuple(_asked(question, now) for question in self.rows.questions),
            contexts=(self.context,) if any(row.context for row in self.rows.found) else (),
        )

    def _restored(self, state: bytes) -> Twin:
        """The twin as the last outcome left it. One that cannot be read again begins anew, the old state kept with the
        reason: version numbers and boots come back with the edge's next message."""
        try:
            return self.model.twin(self.claim.servo, self.rows, state)
        except InvalidInput as error:
            if not state:
                raise
            self.rows.found.append(failed(0, f"{error}; the twin begins anew", {"state": state}))
            return self.model.twin(self.claim.servo, self.rows)

    def _try(self, message: int, act: Callable[[], list[Message]]) -> bool:
        """Let the twin act on a message; where anything goes wrong, it is as if there had been none, and False."""
        kept, asked = len(self.rows.found), len(self.rows.questions)
        self.rows.message = message
        try:
            sent, self.state = act(), self.twin.state()
        except Exception as error:
            self.rows.found[kept:] = [failed(message, f"{type(error).__name__}: {error}")]
            del self.rows.questions[asked:]
            self.twin.restore(self.state)
            return False
        self.sent += sent
        return True


def told(twin: Twin, stored: StoredMessage, now: float) -> list[Message]:
    """What a twin sends after a stored message; one that is switched off does nothing.

    Raises
    ------
    InvalidMessage, InvalidInput
        The body is not understood, or nothing for a twin.
    """
    if stored.kind is MessageKind.VERIFICATION:
        if twin.settings.enabled:
            twin.prove(decode_question(stored.body))
        return []
    message = messages.decode(decompress(stored.body, stored.encoding, MAX_BYTES))
    if not twin.settings.enabled:
        return []
    return twin.learn(message, now, stored.received) if isinstance(message, Window) else twin.receive(message, now)


def _asked(question: Question, now: float) -> Incoming:
    """A proof on the queue."""
    body = encode_question(question)
    digest = hashlib.sha256(body).digest()
    return Incoming(question.servo, MessageKind.VERIFICATION, digest.hex(), body, "", digest, now)


def _unchanged(claim: Lease, taken: Sequence[StoredMessage], why: str) -> WorkResult:
    """The twin as it was, waiting for nothing, and the messages done all the same."""
    evidence = tuple(failed(stored.id, why) for stored in taken)
    return WorkResult(claim.servo, claim.serial, claim.state, None, tuple(stored.id for stored in taken), evidence)
