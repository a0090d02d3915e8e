"""Length-prefixed frames over a stream socket that is never waited for.

Each call moves a bounded number of bytes, so that whoever calls it once per sample knows what it costs.
"""

from __future__ import annotations

import socket
from collections import deque
from struct import Struct

from servotwin.messages import InvalidMessage

_HEAD = Struct("<I")
LONGEST = 64_000_000
"""Bytes of one frame; a window that a twin takes was a fifth of that as doubles."""
PIECE = 65_536
"""Bytes that one call moves."""


class Pipe:
    """One end of a socketpair.

    Parameters
    ----------
    end : socket
        Belongs to the pipe from now on.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._out: deque[memoryview] = deque()
        self._in = bytearray()
        self.broken = False
        self.backlog = 0

    def post(self, frame: bytes) -> None:
        """Put a frame at the end of what is to be sent."""
        self._out.append(memoryview(_HEAD.pack(len(frame))))
        self._out.append(memoryview(frame))
        self.backlog += len(frame) + _HEAD.size

    def pump(self) -> None:
        """Send a piece, if there is one and the other end takes it."""
        if not self._out:
            return
        piece = self._out.popleft()
        try:
            sent = self._end.send(piece[:PIECE])
        except BlockingIOError:
            sent = 0
        except OSError:
            self.broken = True
            return
        self.backlog -= sent
        if sent < len(piece):
            self._out.appendleft(piece[sent:])

    def take(self) -> list[bytes]:
        """The frames that have come meanwhile, of at most one piece of bytes.

        Raises
        ------
        InvalidMessage
            A frame is longer than any.
        """
        try:
            data = self._end.recv(PIECE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self.broken = True
            return []
        self._in += data
        return self._whole()

    def close(self) -> None:
        """Let go of the socket."""
        self._end.close()

    def _whole(self) -> list[bytes]:
        frames, place = [], 0
        while len(self._in) - place >= _HEAD.size:
            (length,) = _HEAD.unpack_from(self._in, place)
            if length > LONGEST:
                raise InvalidMessage(f"frame of {length} bytes: at most {LONGEST} are allowed")
            end = place + _HEAD.size + length
            if len(self._in) < end:
                break
            frames.append(bytes(self._in[place + _HEAD.size : end]))
            place = end
        del self._in[:place]
        return frames
