"""Outlet of the control process: it sends windows, letters and parameters to the link process; no call blocks.

It stores each frame until the link process has acknowledged it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Cut
from servotwin.edge.store import StoredParameters
from servotwin.edge_process import frames
from servotwin.edge_process.frames import AckFrame, MessageFrame, PendingFrame, ReconnectedFrame, SupersededFrame
from servotwin.messages import InvalidMessage, LearntResponse, Message, decode, encode
from servotwin.runtime.frames import FrameError, FrameSocket

BEHIND = "link process behind"
MOST = 64_000_000
"""Bytes stored for a link process that does not acknowledge them; the oldest frames are dropped first."""


class ReceivedFrames:
    """Content of the frames received in one exchange, for the agent.

    Attributes
    ----------
    messages : list of Message
        Messages from the twin.
    pending_changed : bool
        True where the number of windows that wait for the twin's acknowledgement may have changed.
    reconnected : bool
        True where the twin is reached again: the agent sends a hello.
    superseded : bool
        True where another edge of the servo has taken over.
    """

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.pending_changed = self.reconnected = self.superseded = False


class PipeOutlet:
    """`edge.outlet.Outlet` that sends to a link process, and after its end to the next one.

    Parameters
    ----------
    has_twin : bool
        False: no acknowledgements are expected.
    """

    def __init__(self, has_twin: bool) -> None:
        self._has_twin = has_twin
        self.boot = ""
        self._pipe: FrameSocket | None = None
        self._serial = 0
        self._processed = 0
        self._unacknowledged: dict[int, bytes] = {}
        self._windows: set[int] = set()
        self._size = 0
        self._pending = 0
        self._lost: Counter[str] = Counter()
        self._dropped: Mapping[str, int] = {}

    @property
    def unacknowledged(self) -> bool:
        """True where a window waits for the twin's acknowledgement."""
        return self._has_twin and (self._pending > 0 or bool(self._windows))

    @property
    def dropped(self) -> Counter[str]:
        """Number of windows dropped without an acknowledgement in all boots, by reason."""
        return self._lost + Counter(self._dropped)

    @property
    def lost(self) -> Counter[str]:
        """Number of frames dropped here because no link process has taken them, by reason."""
        return self._lost

    @property
    def connected(self) -> bool:
        """True where a link process is connected."""
        return self._pipe is not None and not self._pipe.broken

    @property
    def idle(self) -> bool:
        """True where the link process has acknowledged everything."""
        return not self._unacknowledged and (self._pipe is None or self._pipe.backlog == 0)

    @property
    def untaken(self) -> int:
        """Number of windows that no link process has acknowledged."""
        return len(self._windows)

    @property
    def congested(self) -> bool:
        """True where the link process is so far behind that windows may have to be dropped soon."""
        return self._size > MOST // 2

    def connect(self, pipe: FrameSocket) -> None:
        """Connect to a new link process, and send it everything that the last one has not acknowledged."""
        self.disconnect()
        self._pipe = pipe
        # In their order, from the first unacknowledged one on: the last link process may have died before it stored
        # any.
        for frame in self._unacknowledged.values():
            pipe.post(frame)

    def disconnect(self) -> None:
        """Close the connection to the link process."""
        if self._pipe is not None:
            self._pipe.close()
        self._pipe = None

    def offer(self, cut: Cut) -> None:
        """Take over a cut window."""
        serial = self._send(frames.window_frame(cut, self.boot, self._next_serial()))
        self._windows.add(serial)
        while self._size > MOST:
            self._drop(next(iter(self._unacknowledged)))

    def adopt(self, response: LearntResponse) -> None:
        """Send a learnt response to the window filter, which is in the link process."""
        self._send(frames.ResponseFrame(self._next_serial(), self.boot, encode(response)))

    def send_letter(self, message: Message) -> None:
        """Send a letter to the twin."""
        self._send(frames.LetterFrame(self._next_serial(), encode(message)))

    def save(self, parameters: Parameters) -> None:
        """Have the link process store parameters on disk."""
        self._send(frames.SaveFrame(self._next_serial(), StoredParameters.of(parameters)))

    def send_status(self, frame: frames.StatusFrame) -> None:
        """Send a status, which may be lost; nothing is sent while the link process is behind."""
        # Never behind other frames: a status is worth nothing once it is late.
        if self._pipe is not None and self._pipe.backlog == 0:
            self._pipe.post(frames.encode(frame))

    def exchange(self) -> ReceivedFrames | None:
        """Send a piece and receive a piece; None: nothing came."""
        pipe = self._pipe
        if pipe is None or pipe.broken:
            return None
        pipe.send()
        try:
            bodies = pipe.receive()
            return self._receive(bodies) if bodies else None
        except (FrameError, InvalidMessage):
            pipe.broken = True
            return None

    def _receive(self, bodies: list[bytes]) -> ReceivedFrames:
        received = ReceivedFrames()
        for data in bodies:
            frame = frames.to_control(data)
            if isinstance(frame, AckFrame):
                # The link process sends no PendingFrame where the window was filtered out.
                received.pending_changed |= frame.serial in self._windows
                self._acknowledge(frame.serial)
            elif isinstance(frame, MessageFrame):
                self._message(frame, received)
            elif isinstance(frame, PendingFrame):
                self._pending, self._dropped = frame.pending, frame.dropped
                received.pending_changed = True
            elif isinstance(frame, ReconnectedFrame):
                received.reconnected = True
            elif isinstance(frame, SupersededFrame):
                received.superseded = True
        return received

    def _message(self, frame: MessageFrame, received: ReceivedFrames) -> None:
        """Take a message of the twin's once, even where it is repeated."""
        if frame.serial == 0 or frame.serial > self._processed:
            received.messages.append(decode(frame.body))
        # Reported even where it is a repetition: the link process may have died before it stored the first report.
        if frame.serial > 0:
            self._processed = max(self._processed, frame.serial)
            if self._pipe is not None:
                self._pipe.post(frames.encode(frames.ProcessedFrame(frame.serial)))

    def _next_serial(self) -> int:
        self._serial += 1
        return self._serial

    def _send(self, frame: frames.WindowFrame | frames.LetterFrame | frames.ResponseFrame | frames.SaveFrame) -> int:
        data = frames.encode(frame)
        self._unacknowledged[frame.serial] = data
        self._size += len(data)
        if self._pipe is not None:
            self._pipe.post(data)
        return frame.serial

    def _acknowledge(self, serial: int) -> None:
        self._size -= len(self._unacknowledged.pop(serial, b""))
        self._windows.discard(serial)

    def _drop(self, serial: int) -> None:
        """Drop a frame, and the connection, whose backlog holds it too; the next link process gets the others."""
        if self._pipe is not None:
            self._pipe.broken = True
        self._lost[BEHIND if serial in self._windows else "letter: " + BEHIND] += 1
        self._acknowledge(serial)
