"""What goes to a worker and what comes back, in frames (`runtime.frames`) of MessagePack; no pickles."""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from servotwin.runtime.frames import frame
from servotwin.store.records import Lease, WorkResult


class Start(NamedTuple):
    """What a worker needs to know once.

    Attributes
    ----------
    text : str
        The twin's file.
    source, folder : str
        Its name in messages; paths in it are relative to the folder.
    """

    text: str
    source: str
    folder: str


class Job(NamedTuple):
    """Servos to be worked on one after the other; `now` in s: since the epoch, or sample time in lock-step."""

    claims: tuple[Lease, ...]
    now: float


class Done(NamedTuple):
    """What became of one claim.

    Attributes
    ----------
    outcome : WorkResult or None
    error : str
        Why there is none.
    seconds : float
        What it took.
    """

    outcome: WorkResult | None
    error: str
    seconds: float


_encoder = msgspec.msgpack.Encoder()
start_of = msgspec.msgpack.Decoder(Start).decode
job_of = msgspec.msgpack.Decoder(Job).decode
done_of = msgspec.msgpack.Decoder(Done).decode


def framed(message: Start | Job | Done) -> bytes:
    """The message's frame."""
    return frame(_encoder.encode(message))
