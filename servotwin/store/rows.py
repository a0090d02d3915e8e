"""What goes into the store and what comes out of it: plain values; the store knows nothing of what their bytes mean."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Kind(StrEnum):
    """What an incoming message is to the store."""

    WINDOW = "window"
    LETTER = "letter"
    PROOF = "proof"


class Incoming(NamedTuple):
    """A message to be kept exactly once.

    Attributes
    ----------
    servo : str
    kind : Kind
        A window; a letter (hello, receipt, fallback, answer); or a proof that the twin asks itself for.
    key : str
        Unique within the servo for ever: "boot/sequence" of a window, a digest of any other's body.
    body : bytes
        As it came, encoded by `encoding`.
    encoding : str
        "" (identity), "deflate" or "zstd".
    digest : bytes
        Of the decoded body: equal for equal messages, whatever the encoding.
    received : float
        s since the epoch.
    boot, sequence, start : str, int, float
        Of a window; elsewhere "", 0 and 0.0.
    """

    servo: str
    kind: Kind
    key: str
    body: bytes
    encoding: str
    digest: bytes
    received: float
    boot: str = ""
    sequence: int = 0
    start: float = 0.0


class Put(StrEnum):
    """What became of an incoming message."""

    NEW = "new"
    KNOWN = "known"
    CONFLICT = "conflict"


class Stored(NamedTuple):
    """A kept message; `key` as of `Incoming`."""

    id: int
    kind: Kind
    body: bytes
    encoding: str
    received: float
    key: str = ""


class Claim(NamedTuple):
    """A servo with work to do, lent to one worker.

    Attributes
    ----------
    servo : str
    state : bytes
        The twin's, as the last outcome left it; empty before the first.
    serial : int
        How many outcomes the servo has had: what the next one has to name.
    messages : tuple of Stored
        Not yet processed, in the order in which they were committed; empty where only the time to wake has come.
    attempts : int
        How often the servo was lent since its last outcome, this time included: more than a few times means that a
        worker dies of it.
    """

    servo: str
    state: bytes
    serial: int
    messages: tuple[Stored, ...]
    attempts: int = 1


class Evidence(NamedTuple):
    """One thing that was found or done.

    Attributes
    ----------
    kind : str
        glance, estimate, disturbance, trend, redesign, excitation, update, request, receipt, fallback, answer, hello,
        proof, withdrawn.
    message : int
        Id of the message that led to it; 0: none did.
    body : bytes
        MessagePack.
    version : int or None
        Of the parameters: those that an update carries, a receipt or a fallback is about, or, for a glance or an
        estimate, those in force when its window was cut: so the effect of a version is found.
    gap, std : float or None
        rad, for queries.
    status : str
        For queries: the estimate's status, the receipt's reason, why nothing was redesigned.
    context : str
        Key of the context under which it was computed; empty: does not matter.
    tail : float or None
        m, for queries: of a glance or an estimate, the largest tracking error in the last tenth of its window.
    window : str
        "boot/sequence" of the window that it stands on, where `message` may be another one: of an update that had to
        wait for a receipt, or for a proof on the queue. It is kept as that window's.
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


class Outcome(NamedTuple):
    """What a worker made of a claim; committed as a whole or not at all.

    Attributes
    ----------
    servo : str
    serial : int
        The claim's: another outcome since then voids this one.
    state : bytes
    wake : float or None
        s since the epoch at which the twin wants to be woken.
    done : tuple of int
        Ids of the messages that it covers.
    evidence : tuple of Evidence
    outgoing : tuple of bytes
        Messages to the edge, in order.
    enqueue : tuple of Incoming
        Messages of the twin to itself.
    contexts : tuple of (str, str)
        (key, JSON text) of the contexts that the evidence names.
    """

    servo: str
    serial: int
    state: bytes
    wake: float | None
    done: tuple[int, ...]
    evidence: tuple[Evidence, ...] = ()
    outgoing: tuple[bytes, ...] = ()
    enqueue: tuple[Incoming, ...] = ()
    contexts: tuple[tuple[str, str], ...] = ()


class Posted(NamedTuple):
    """A message on its way to the edge; serials rise per servo."""

    serial: int
    body: bytes


class Waiting(NamedTuple):
    """What is not yet processed.

    Attributes
    ----------
    messages, proofs : int
        Windows and letters; what the twin asks itself for.
    age : float
        s since the oldest window or letter came; 0.0: none waits.
    """

    messages: int
    proofs: int
    age: float


class Summary(NamedTuple):
    """One servo at a glance.

    Attributes
    ----------
    serial, windows, waiting : int
        Outcomes so far, windows kept, windows and letters not yet processed.
    heard : float or None
        s since the epoch, when its last message came.
    wake : float or None
        s since the epoch at which its twin wants to be woken.
    gap, std : float or None
        rad, of the newest glance or estimate.
    status : str
        Of the same.
    version : int or None
        Of the newest update.
    receipt : str
        Status of the newest receipt; empty: none came.
    posted : int
        Serial of the newest message to the edge.
    """

    servo: str
    serial: int
    windows: int
    waiting: int
    heard: float | None
    wake: float | None
    gap: float | None
    std: float | None
    status: str
    version: int | None
    receipt: str
    posted: int
