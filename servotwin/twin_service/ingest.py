"""Ingest of messages from edges, over any transport: check, decode, commit; only then is a message acknowledged."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
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
    WindowMessage,
    decode,
    encode,
)
from servotwin.messages.codec import decompress
from servotwin.store.engine import StoreBusy, StoreUnavailable
from servotwin.store.integrity import message_digest
from servotwin.store.records import Incoming, MessageKind, PutResult
from servotwin.twin_service.backlog_pace import BacklogPace
from servotwin.twin_service.limits import RateLimiter, RequestRejected, SampleTimeLimiter
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.store_executor import unavailable

LETTERS = (Hello, Receipt, Fallback, Answer)


class Clocks(NamedTuple):
    """Clocks of the service, s: since the epoch, and monotonic."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic

    @classmethod
    def of_machine(cls) -> Clocks:
        """Clocks of the machine, unaffected by steps of its clock while the service runs.

        Leases and wake-ups are on this clock: set back by an hour, it would delay them by that hour. It goes on while
        the machine sleeps: behind by an hour it would take the leases of all other twins for ended.
        """
        zero = time.time() - _elapsed()
        return cls(lambda: zero + _elapsed())


# On Linux CLOCK_MONOTONIC, which is time.monotonic, stands still while the machine sleeps; macOS has it the other way
# round; Windows has neither number, and its time.monotonic goes on.
_AWAKE_OR_NOT: int | None = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def _elapsed() -> float:
    """Time since some moment (s), the machine's sleep included."""
    return time.monotonic() if _AWAKE_OR_NOT is None else time.clock_gettime(_AWAKE_OR_NOT)


async def _no_conflict(_servo: str, _boot: str, _sequence: int) -> None:
    return


class Ingest:
    """Checks and stores messages of edges.

    Parameters
    ----------
    put : callable
        Returns once the message is committed; raises StoreBusy where the queue is full, and StoreUnavailable.
    has_servo : callable
        Test whether a servo of that name belongs to this twin.
    sample_times : SampleTimeLimiter
    metrics : Metrics
    limit : int
        Bytes of a message, decompressed.
    clocks : Clocks
    note : callable
        Called with each window that was new.
    samples : int
        Largest number of samples of a window: the time and the memory of the work on it grow with them.
    disk : RateLimiter, optional
        Limits the bytes that a servo adds to the store.
    conflict : callable
        Called with servo, boot and sequence of a window that came under the name of another one.
    pace : BacklogPace, optional
        Pace of the edges' backlogs; None: as fast as they come.
    """

    def __init__(
        self,
        put: Callable[[Incoming], Awaitable[PutResult]],
        has_servo: Callable[[str], bool],
        sample_times: SampleTimeLimiter,
        metrics: Metrics,
        limit: int = MAX_BYTES,
        clocks: Clocks | None = None,
        note: Callable[[WindowMessage], None] = lambda _window: None,
        samples: int = MAX_BYTES,
        disk: RateLimiter | None = None,
        conflict: Callable[[str, str, int], Awaitable[None]] = _no_conflict,
        pace: BacklogPace | None = None,
    ) -> None:
        self._conflict = conflict
        self._note, self._samples, self._disk, self._pace = note, samples, disk, pace
        self._put, self._has_servo, self._sample_times = put, has_servo, sample_times
        self._metrics, self._limit = metrics, limit
        self._clocks = clocks or Clocks()

    def read_window(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, WindowMessage]:
        """Decode a window of that servo; raises RequestRejected as `read` does."""
        incoming, message = self.read(servo, body, encoding)
        if not isinstance(message, WindowMessage):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"a window is expected here, not {_kind(message)}")
        return incoming, message

    def read_letter(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, Message]:
        """Decode a hello, receipt, fallback or answer of that servo; raises RequestRejected as `read` does."""
        incoming, message = self.read(servo, body, encoding)
        if isinstance(message, WindowMessage):
            raise RequestRejected(
                Refusal.NOT_UNDERSTOOD, "a hello, receipt, fallback or answer is expected here, not window"
            )
        return incoming, message

    def read(self, servo: str, body: bytes, encoding: str = "") -> tuple[Incoming, Message]:
        """Check and decode a message of that servo.

        Parameters
        ----------
        servo : str
            Authenticated.
        body : bytes
            As received, compressed as `encoding` says: "", "deflate" or "zstd".

        Raises
        ------
        RequestRejected
            The message is not for a twin, or invalid; `refusal` is the reason.
        """
        data, message = self._decoded(servo, body, encoding)
        now, digest = self._clocks.monotonic(), message_digest(data)
        if isinstance(message, WindowMessage):
            self._check_samples(message)
            self._sample_times.check(servo, message.boot, end_of(message), now)
            incoming = Incoming(
                servo=servo,
                kind=MessageKind.WINDOW,
                key=f"{message.boot}/{message.sequence}",
                body=body,
                encoding=encoding,
                digest=digest,
                received=self._clocks.wall(),
                boot=message.boot,
                sequence=message.sequence,
                start=message.start,
                overtaken=self._pace is not None and self._pace.has_overtaken(servo, message.boot, message.start),
            )
            return incoming, message
        if not isinstance(message, LETTERS):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"a twin does not receive {_kind(message)} messages")
        if isinstance(message, Hello):
            self._sample_times.hello(servo, message.boot, message.time, now)
        return Incoming(servo, MessageKind.LETTER, digest.hex(), body, encoding, digest, self._clocks.wall()), message

    def decode(self, servo: str, body: bytes, encoding: str = "") -> Message:
        """Decode a message of that servo that is not to be stored; raises RequestRejected as `read` does."""
        return self._decoded(servo, body, encoding)[1]

    async def commit(self, incoming: Incoming, message: Message) -> PutResult:
        """Commit a message that was read; returns when it is on the disk.

        Raises
        ------
        RequestRejected
            CONFLICT: another message was committed under this key. SUPERSEDED: so it was of earlier ones, as of two
            copies of one edge. UNAVAILABLE, TOO_MANY: it may succeed later.
        """
        begun = self._clocks.monotonic()
        if self._disk is not None:
            self._disk.take(incoming.servo, len(incoming.body))
        put = PutResult.CONFLICT
        try:
            put = await self._put(incoming)
        except (StoreBusy, StoreUnavailable) as error:
            busy = isinstance(error, StoreBusy)
            detail = "too many messages wait to be committed" if busy else "the store cannot be written now"
            raise unavailable(error, detail) from None
        finally:
            if self._disk is not None and put is not PutResult.NEW:
                self._disk.give_back(incoming.servo, len(incoming.body))
        if put is PutResult.CONFLICT:
            if isinstance(message, WindowMessage):
                await self._conflict(message.servo, message.boot, message.sequence)
            raise RequestRejected(
                Refusal.CONFLICT, f"{incoming.kind.value} {incoming.key}: another message is stored under this key"
            )
        self._metrics.commit.observe(self._clocks.monotonic() - begun)
        self._metrics.stored.add(incoming.kind.value, put.value)
        if put is PutResult.NEW and isinstance(message, WindowMessage):
            self._note(message)
            if self._pace is not None:
                self._pace.note(incoming.servo, message.boot, message.start)
        return put

    def older_pause(self, servo: str, waiting: int) -> float:
        """Pause before older windows (s) of a servo whose window was committed, and that has so many others to send."""
        return 0.0 if self._pace is None else round(self._pace.pause(servo, waiting), 1)

    def _check_samples(self, window: WindowMessage) -> None:
        if window.samples > self._samples:
            detail = f"the window has {window.samples} samples; at most {self._samples} are allowed"
            raise RequestRejected(Refusal.TOO_LARGE, detail)

    def _decoded(self, servo: str, body: bytes, encoding: str) -> tuple[bytes, Message]:
        # Before the body is decompressed and decoded, which costs far more.
        if not self._has_servo(servo):
            raise RequestRejected(Refusal.UNKNOWN_SERVO, f"this twin has no servo {servo!r}")
        try:
            data = decompress(body, encoding, self._limit)
            message = decode(data, self._limit)
        except InvalidMessage as error:
            raise RequestRejected(error.refusal, str(error)[:400]) from None
        if message.servo != servo:
            raise RequestRejected(Refusal.OTHER_NAME, f"the message is of servo {message.servo!r}, not of {servo!r}")
        return data, message


def end_of(window: WindowMessage) -> float:
    """Sample time of a window's last sample, s."""
    return window.start + (window.samples - 1) / window.rate


def acknowledgement(window: WindowMessage) -> bytes:
    """Message that tells the edge that its window is safe."""
    return encode(Acknowledge(window.servo, window.boot, window.sequence))


def _kind(message: Message) -> str:
    return type(message).__name__.lower()
