"""The control process's outlet: what the agent cuts, says and proves goes to the link process, and is kept until it has
taken it; no call waits for anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from servotwin.edge.cut import Cut
from servotwin.edge.parameters import Parameters
from servotwin.edge.store import StoredParameters
from servotwin.edge_process import frames
from servotwin.edge_process.frames import BackFrame, DoneFrame, HeardFrame, StandingFrame
from servotwin.messages import Acknowledge, InvalidMessage, Message, Window, decode, encode
from servotwin.runtime.frames import FrameError, FrameSocket

BEHIND = "link process behind"
MOST = 64_000_000
"""Bytes that are kept for a link process that does not take them."""


class Heard:
    """What came from the link process: messages for the agent, and whether the agent must look or say hello."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.standing = self.back = False


class PipeOutlet:
    """Implements `edge.outlet.Outlet`; speaks to one link process after the other.

    Parameters
    ----------
    owed : bool
        Whether there is a twin at all, who owes acknowledgements.
    """

    next_time: float | None = None

    def __init__(self, owed: bool) -> None:
        self._owed = owed
        self.boot = ""
        self._pipe: FrameSocket | None = None
        self._serial = 0
        self._handled = 0
        self._kept: dict[int, bytes] = {}
        self._cuts: set[int] = set()
        self._size = 0
        self._waiting = 0
        self._lost: Counter[str] = Counter()
        self._dropped: Mapping[str, int] = {}

    @property
    def waiting(self) -> bool:
        """Whether the twin owes the acknowledgement of a window."""
        return self._owed and (self._waiting > 0 or bool(self._cuts))

    @property
    def dropped(self) -> Counter[str]:
        """Windows that will never be sent without having been acknowledged, by reason, of all boots."""
        return self._lost + Counter(self._dropped)

    @property
    def lost(self) -> Counter[str]:
        """Of those, what never came to the link process."""
        return self._lost

    @property
    def connected(self) -> bool:
        """Whether a link process listens."""
        return self._pipe is not None and not self._pipe.broken

    @property
    def settled(self) -> bool:
        """Whether the link process has taken everything."""
        return not self._kept and (self._pipe is None or self._pipe.backlog == 0)

    @property
    def untaken(self) -> int:
        """Windows that no link process is known to have on the disk."""
        return len(self._cuts)

    @property
    def behind(self) -> bool:
        """Whether the link process has so much to take that windows may have to be given up soon."""
        return self._size > MOST // 2

    def connect(self, pipe: FrameSocket) -> None:
        """A new link process: it is given everything that the last one may not have taken."""
        self.disconnect()
        self._pipe = pipe
        for frame in self._kept.values():
            pipe.post(frame)

    def disconnect(self) -> None:
        """There is no link process."""
        if self._pipe is not None:
            self._pipe.close()
        self._pipe = None

    def offer(self, cut: Cut, now: float) -> None:  # noqa: ARG002
        """Take charge of what was cut."""
        serial = self._keep(frames.framed(cut, self.boot, self._next()))
        self._cuts.add(serial)
        while self._size > MOST:
            self._give_up(next(iter(self._kept)))

    def due(self, now: float) -> list[Window]:  # noqa: ARG002
        """Nothing: the link process sends."""
        return []

    def acknowledged(self, message: Acknowledge) -> bool:  # noqa: ARG002
        """The link process knows first, and tells how many wait."""
        return True

    def say(self, message: Message) -> None:
        """Send a letter to the twin."""
        self._keep(frames.LetterFrame(self._next(), encode(message)))

    def save(self, parameters: Parameters) -> None:
        """Let these parameters be kept on disk."""
        self._keep(frames.SaveFrame(self._next(), StoredParameters.of(parameters)))

    def tell(self, frame: frames.TicksFrame) -> None:
        """Something that may be lost; left out when the link process is behind."""
        if self._pipe is not None and self._pipe.backlog == 0:
            self._pipe.post(frames.encode(frame))

    def exchange(self) -> Heard | None:
        """Send a piece, take a piece; None: nothing came."""
        pipe = self._pipe
        if pipe is None or pipe.broken:
            return None
        pipe.send()
        try:
            came = pipe.receive()
            return self._hear(came) if came else None
        except (FrameError, InvalidMessage):
            pipe.broken = True
            return None

    def _hear(self, came: list[bytes]) -> Heard:
        heard = Heard()
        for data in came:
            frame = frames.to_control(data)
            if isinstance(frame, DoneFrame):
                heard.standing |= frame.serial in self._cuts  # perhaps nothing is owed now, and nobody else says so
                self._done(frame.serial)
            elif isinstance(frame, HeardFrame):
                self._message(frame, heard)
            elif isinstance(frame, StandingFrame):
                self._waiting, self._dropped = frame.waiting, frame.dropped
                heard.standing = True
            elif isinstance(frame, BackFrame):
                heard.back = True
        return heard

    def _message(self, frame: HeardFrame, heard: Heard) -> None:
        """A message of the twin's counts once, whoever repeats it."""
        if frame.serial == 0 or frame.serial > self._handled:
            heard.messages.append(decode(frame.body))
        if frame.serial > 0:
            self._handled = max(self._handled, frame.serial)
            if self._pipe is not None:
                self._pipe.post(frames.encode(frames.HandledFrame(frame.serial)))

    def _next(self) -> int:
        self._serial += 1
        return self._serial

    def _keep(self, frame: frames.CutFrame | frames.LetterFrame | frames.SaveFrame) -> int:
        data = frames.encode(frame)
        self._kept[frame.serial] = data
        self._size += len(data)
        if self._pipe is not None:
            self._pipe.post(data)
        return frame.serial

    def _done(self, serial: int) -> None:
        self._size -= len(self._kept.pop(serial, b""))
        self._cuts.discard(serial)

    def _give_up(self, serial: int) -> None:
        """A link process so far behind is given up too: the next one gets what is still kept."""
        if self._pipe is not None:
            self._pipe.broken = True
        self._lost[BEHIND if serial in self._cuts else "letter: " + BEHIND] += 1
        self._done(serial)
