"""What comes in, over any transport: checked, made an `Incoming`, committed; only then it counts as taken."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from hashlib import blake2b
from typing import NamedTuple

from servotwin.messages import (
    MAX_BYTES,
    Acknowledge,
    Answer,
    Fallback,
    Hello,
    InvalidMessage,
    Message,
    Receipt,
    Refusal,
    Window,
    decode,
    encode,
)
from servotwin.messages.compression import decompress
from servotwin.store.engine import StoreBusy, StoreUnavailable
from servotwin.store.records import Incoming, MessageKind, PutResult
from servotwin.twin_service.future import Boots
from servotwin.twin_service.metrics import Metrics
from servotwin.twin_service.refused import Refused

LETTERS = (Hello, Receipt, Fallback, Answer)


_PIECE = 2047


class Clocks(NamedTuple):
    """Time as the service sees it: since the epoch, and the one that never steps, both in s."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic

    @classmethod
    def of_machine(cls) -> Clocks:
        """The machine's, where a step of its clock while the service runs changes nothing.

        Leases and times to wake lie on this clock: set back by an hour, it would let them lie for that hour.
        """
        zero = time.time() - time.monotonic()
        return cls(lambda: zero + time.monotonic())


class Ingest:
    """Takes messages of edges.

    Parameters
    ----------
    put : callable
        Commits, and returns then; raises StoreBusy when too much waits, and StoreUnavailable.
    knows : callable
        Whether a servo of that name is looked after here.
    boots : Boots
    metrics : Metrics
    limit : int
        Bytes of a message, decompressed.
    clocks : Clocks
    """

    def __init__(
        self,
        put: Callable[[Incoming], Awaitable[PutResult]],
        knows: Callable[[str], bool],
        boots: Boots,
        metrics: Metrics,
        limit: int = MAX_BYTES,
        clocks: Clocks | None = None,
    ) -> None:
        self._put, self._knows, self._boots, self._metrics, self._limit = put, knows, boots, metrics, limit
        self._clocks = clocks or Clocks()

    def read_window(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, Window]:
        """A window of that servo, ready to be put; raises Refused as `read` does."""
        incoming, message = self.read(servo, body, encoding)
        if not isinstance(message, Window):
            raise Refused(Refusal.NOT_UNDERSTOOD, f"a window is expected here, not {_kind(message)}")
        return incoming, message

    def read_letter(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, Message]:
        """A hello, receipt, fallback or answer of that servo, ready to be put; raises Refused as `read` does."""
        incoming, message = self.read(servo, body, encoding)
        if isinstance(message, Window):
            raise Refused(Refusal.NOT_UNDERSTOOD, "a hello, receipt, fallback or answer is expected here, not window")
        return incoming, message

    def read(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, Message]:
        """A message of that servo, ready to be put.

        Parameters
        ----------
        servo : str
            Whoever sent it has shown to be this one.
        body : bytes
            As it came, compressed as `encoding` says: "", "deflate" or "zstd".

        Raises
        ------
        Refused
            It is not for a twin, or no good; the reason is its code.
        """
        data, message = self._decoded(servo, body, encoding)
        now, digest = self._clocks.monotonic(), _digest(data)
        if isinstance(message, Window):
            self._boots.check(servo, message.boot, end_of(message), now)
            of_window = message.boot, message.sequence, message.start
            whose = servo, MessageKind.WINDOW, f"{message.boot}/{message.sequence}"
            return Incoming(*whose, body, encoding, digest, self._clocks.wall(), *of_window), message
        if not isinstance(message, LETTERS):
            raise Refused(Refusal.NOT_UNDERSTOOD, f"a twin does not receive {_kind(message)} messages")
        if isinstance(message, Hello):
            self._boots.hello(servo, message.boot, message.time, now)
        return Incoming(servo, MessageKind.LETTER, digest.hex(), body, encoding, digest, self._clocks.wall()), message

    async def commit(self, incoming: Incoming) -> PutResult:
        """Commit; returns when it is safe.

        Raises
        ------
        Refused
            CONFLICT: something else was committed under this identity. UNAVAILABLE: it may be taken later.
        """
        begun = self._clocks.monotonic()
        try:
            put = await self._put(incoming)
        except (StoreBusy, StoreUnavailable) as error:
            raise Refused(Refusal.UNAVAILABLE, _unavailable(error)) from None
        if put is PutResult.CONFLICT:
            raise Refused(Refusal.CONFLICT, f"{incoming.kind.value} {incoming.key}: another one is kept")
        self._metrics.commit.observe(self._clocks.monotonic() - begun)
        self._metrics.taken.add(incoming.kind.value, put.value)
        return put

    def _decoded(self, servo: str, body: bytes, encoding: str) -> tuple[bytes, Message]:
        if not self._knows(servo):
            raise Refused(Refusal.UNKNOWN_SERVO, f"servo {servo!r} is not looked after here")
        try:
            data = decompress(body, encoding, self._limit)
            message = decode(data, self._limit)
        except InvalidMessage as error:
            raise Refused(error.refusal, str(error)[:400]) from None
        if message.servo != servo:
            raise Refused(Refusal.OTHER_NAME, f"the message is of servo {message.servo!r}, not of {servo!r}")
        return data, message


def end_of(window: Window) -> float:
    """Sample time of a window's last sample, s."""
    return window.start + (window.samples - 1) / window.rate


def acknowledgement(window: Window) -> bytes:
    """What tells the edge that its window is safe."""
    return encode(Acknowledge(window.servo, window.boot, window.sequence))


def _digest(data: bytes) -> bytes:
    """Of the whole, in pieces so small that hashlib keeps the interpreter to itself.

    With larger ones it lets another thread in, and the event loop gets its turn again after that thread's: 270 us
    instead of 25 for 20 kB while commits are being written.
    """
    whole, digest = memoryview(data), blake2b(digest_size=16)
    for begin in range(0, len(data), _PIECE):
        digest.update(whole[begin : begin + _PIECE])
    return digest.digest()


def _kind(message: Message) -> str:
    return type(message).__name__.lower()


def _unavailable(error: Exception) -> str:
    busy = isinstance(error, StoreBusy)
    return "so much waits to be committed that no more is taken now" if busy else "the store cannot take anything now"
