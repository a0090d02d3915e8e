"""Records that go into the store and come out of it: plain values; the store does not interpret their bytes."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

LONGEST_WAKE_S = 60.0
"""s from the work until the servo's next wake-up, at most; one that is more than twice that ahead was set under a clock
that was ahead, and is due."""


class MessageKind(StrEnum):
    """Kind of an incoming message, as stored in `messages.kind`."""

    WINDOW = "window"
    LETTER = "letter"
    ACT = "act"
    VERIFICATION = "verification"


class Incoming(NamedTuple):
    """A message to be stored exactly once.

    Attributes
    ----------
    servo : str
    kind : MessageKind
        A window; a letter (hello, receipt, fallback, answer); an engineer's act; or a verification that the twin
        requests of itself.
    key : str
        Unique within the servo for ever: "boot/sequence" of a window, a digest of any other's body.
    body : bytes
        As received, compressed as `encoding` says.
    encoding : str
        "" (identity), "deflate" or "zstd".
    digest : bytes
        Of the decoded body: equal for equal messages, whatever the encoding.
    received : float
        s since the epoch.
    boot, sequence, start : str, int, float
        Key and sample time of a window; "", 0 and 0.0 for other kinds.
    overtaken : bool
        A newer window of the servo was stored before: new messages of others come first. It is not stored.
    """

    servo: str
    kind: MessageKind
    key: str
    body: bytes
    encoding: str
    digest: bytes
    received: float
    boot: str = ""
    sequence: int = 0
    start: float = 0.0
    overtaken: bool = False


class PutResult(StrEnum):
    """Result of storing an incoming message: new, a duplicate, or in conflict with another one under the same key."""

    NEW = "new"
    KNOWN = "known"
    CONFLICT = "conflict"


class StoredMessage(NamedTuple):
    """A message in the store; `key` as in `Incoming`."""

    id: int
    kind: MessageKind
    body: bytes
    encoding: str
    received: float
    key: str = ""


class Lease(NamedTuple):
    """A servo with pending work, leased to one worker.

    Attributes
    ----------
    servo : str
    state : bytes
        State of the twin after the last result; empty before the first.
    serial : int
        Number of results that the servo has had: the next result has to name it.
    messages : tuple of StoredMessage
        Unprocessed, in the order of their commits; empty where only a wake-up is due.
    attempts : int
        Number of leases of the servo since its last result, this one included. More than a few mean that the work kills
        its workers.
    estimate : bool
        The servo's turn is for the estimate of a window that was deferred.
    """

    servo: str
    state: bytes
    serial: int
    messages: tuple[StoredMessage, ...]
    attempts: int = 1
    estimate: bool = False


TOO_LATE = "too late"
"""Status of a redesign begins so, where nothing was computed because it would have come too late."""


class EvidenceRecord(NamedTuple):
    """One piece of evidence: an estimate, a decision or an event of a twin.

    Attributes
    ----------
    kind : str
        glance, estimate, disturbance, trend, redesign, excitation, update, request, receipt, fallback, answer, hello,
        verification, withdrawn, proposal, act.
    message : int
        Id of the message that led to it; 0: none.
    body : bytes
        MessagePack.
    version : int or None
        Version of the parameters: the one that an update carries, that a receipt or a fallback names, or, for a glance
        or an estimate, the one in force when its window was cut. It links a version to its effect.
    gap, std : float or None
        rad, for queries.
    status : str
        For queries: the estimate's status, the receipt's reason, why nothing was redesigned.
    context : str
        Key of the context in which it was computed; empty: none.
    tail : float or None
        m, for queries: of a glance or an estimate, the largest tracking error in the last tenth of its window.
    window : str
        "boot/sequence" of the window that it is based on, where `message` is another one: an update that waited for a
        receipt or for a verification. It is stored as that window's evidence.
    overtaken : bool
        True where a newer window of the servo was processed before: it does not change the servo's summary.
    """

    kind: str
    message: int
    body: bytes
    version: int | None = None
    gap: float | None = None
    std: float | None = None
    status: str = ""
    context: str = ""
    tail: float | None = None
    window: str = ""
    overtaken: bool = False


class WorkResult(NamedTuple):
    """Result of a worker's lease; committed as a whole or not at all.

    Attributes
    ----------
    servo : str
    serial : int
        The lease's: a result that was committed since then voids this one.
    state : bytes
    wake : float or None
        s since the epoch at which the twin is to be woken, within LONGEST_WAKE_S.
    done : tuple of int
        Ids of the messages that it covers.
    evidence : tuple of EvidenceRecord
    outgoing : tuple of bytes
        Messages to the edge, in order.
    enqueue : tuple of Incoming
        Messages of the twin to itself.
    contexts : tuple of (str, str)
        (key, JSON text) of the contexts that the evidence names.
    deferred : int or None
        Id of a window that stays unprocessed until the servo's turn for an estimate; 0: none. None: the work was not
        on windows, and what was deferred stays so.
    """

    servo: str
    serial: int
    state: bytes
    wake: float | None
    done: tuple[int, ...]
    evidence: tuple[EvidenceRecord, ...] = ()
    outgoing: tuple[bytes, ...] = ()
    enqueue: tuple[Incoming, ...] = ()
    contexts: tuple[tuple[str, str], ...] = ()
    deferred: int | None = None


class OutgoingMessage(NamedTuple):
    """A message to an edge; serials rise per servo."""

    serial: int
    body: bytes


class Backlog(NamedTuple):
    """Unprocessed messages.

    Attributes
    ----------
    messages, verifications : int
        Windows and letters; verifications that twins requested of themselves.
    age : float
        s since the oldest window or letter was received; 0.0: none waits.
    lag : float
        s for which new messages of a servo have waited for its turn, or a servo for an estimate: the longest of all
        servos. A backlog that newer messages have overtaken does not count.
    """

    messages: int
    verifications: int
    age: float
    lag: float = 0.0


class ServoSummary(NamedTuple):
    """Summary of one servo.

    Attributes
    ----------
    serial, windows, waiting : int
        Results so far, windows stored, windows and letters not yet processed.
    last_message : float or None
        s since the epoch at which its last message was received.
    wake : float or None
        s since the epoch at which its twin is to be woken.
    gap, std : float or None
        rad, of the newest glance or estimate.
    status : str
        Of the same.
    version : int or None
        Of the newest update.
    receipt : str
        Status of the newest receipt; empty: none was received.
    posted : int
        Serial of the newest message to the edge.
    """

    servo: str
    serial: int
    windows: int
    waiting: int
    last_message: float | None
    wake: float | None
    gap: float | None
    std: float | None
    status: str
    version: int | None
    receipt: str
    posted: int


class StoredWindow(NamedTuple):
    """A window in the store, without its body.

    Attributes
    ----------
    start : float
        Sample time of its first sample, s.
    received, done : float, float or None
        s since the epoch, when it was received and when it was processed.
    """

    id: int
    servo: str
    boot: str
    sequence: int
    start: float
    received: float
    done: float | None


class StoredEvidence(NamedTuple):
    """Evidence in the store; the fields that are not here are those of `EvidenceRecord`.

    Attributes
    ----------
    created : float
        s since the epoch, when it was stored.
    received : float or None
        s since the epoch, when the letter or act came that led to it; None: none did, or it was not asked for.
    """

    id: int
    kind: str
    message: int
    body: bytes
    version: int | None
    gap: float | None
    std: float | None
    status: str
    context: str
    tail: float | None
    created: float
    received: float | None = None

    @property
    def time(self) -> float:
        """s since the epoch at which its letter was received, or it was stored: under load long after that."""
        return self.created if self.received is None else self.received


class UpdateEffect(NamedTuple):
    """Effect of a version, as the first window under it shows.

    Attributes
    ----------
    window : StoredWindow
        The first one that was cut under the version.
    before, after : StoredEvidence
        The glance or estimate of the window that the version is based on, and of the first one under it: compare their
        `tail`, `gap` and `status`.
    """

    window: StoredWindow
    before: StoredEvidence | None
    after: StoredEvidence


class UpdateTrace(NamedTuple):
    """An update, the receipts and fallbacks that name its version, and its effect, if a window shows one."""

    update: StoredEvidence
    answers: tuple[StoredEvidence, ...]
    effect: UpdateEffect | None


class WindowTrace(NamedTuple):
    """A window and everything that followed from it: the evidence chain.

    Attributes
    ----------
    window : StoredWindow
    evidence : tuple of StoredEvidence
        Glances, estimates, redesigns and so on, updates excepted.
    steps : tuple of UpdateTrace
        Its updates: mostly none or one.
    """

    window: StoredWindow
    evidence: tuple[StoredEvidence, ...]
    steps: tuple[UpdateTrace, ...]
