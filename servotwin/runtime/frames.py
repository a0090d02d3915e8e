"""Length-prefixed frames over a stream: four bytes of length, little-endian, then the body."""

from __future__ import annotations

import socket
from collections import deque
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    import asyncio

_HEAD = Struct("<I")
LONGEST = 64_000_000
"""Bytes of the longest frame that `FrameSocket` accepts: five times the largest window as doubles."""
_PIECE = 65_536
"""Bytes that one call of `FrameSocket` moves at most."""


class FrameError(Exception):
    """The bytes received are not frames."""


def frame(body: bytes) -> bytes:
    """Put the length before the body."""
    return _HEAD.pack(len(body)) + body


def read_frame(stream: BinaryIO) -> bytes | None:
    """Read the body of the next frame, waiting for it; None: the stream has ended."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    length: int = _HEAD.unpack(head)[0]
    body = stream.read(length)
    return body if len(body) == length else None


async def receive_frame(reader: asyncio.StreamReader) -> bytes:
    """Read the body of the next frame; raises asyncio.IncompleteReadError where the stream has ended."""
    return await reader.readexactly(_HEAD.unpack(await reader.readexactly(_HEAD.size))[0])


class FrameSocket:
    """Frames over a stream socket; no call blocks.

    Each call moves a bounded number of bytes, so that the cost of one call per sample is bounded in a control loop.

    Parameters
    ----------
    end : socket
        This object owns it from now on.

    Attributes
    ----------
    broken : bool
        The other end has closed the connection.
    backlog : int
        Bytes still to be sent.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._out: deque[memoryview] = deque()
        self._in = bytearray()
        self.broken = False
        self.backlog = 0

    def post(self, body: bytes) -> None:
        """Append a frame to the backlog."""
        self._out.append(memoryview(_HEAD.pack(len(body))))
        self._out.append(memoryview(body))
        self.backlog += len(body) + _HEAD.size

    def send(self) -> None:
        """Send a piece of the backlog, as much as the socket accepts."""
        if not self._out:
            return
        piece = self._out.popleft()
        try:
            sent = self._end.send(piece[:_PIECE])
        except BlockingIOError:
            sent = 0
        except OSError:
            self.broken = True
            return
        self.backlog -= sent
        if sent < len(piece):
            # The rest goes first: parts of two frames must not mix.
            self._out.appendleft(piece[sent:])

    def receive(self) -> list[bytes]:
        """Read at most one piece, and return the bodies of the frames that are complete.

        Raises
        ------
        FrameError
            A frame is longer than `LONGEST`.
        """
        try:
            data = self._end.recv(_PIECE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        # No bytes where there was no error: the other end has closed the connection.
        if not data:
            self.broken = True
            return []
        self._in += data
        return self._complete()

    def close(self) -> None:
        """Close the socket."""
        self._end.close()

    def _complete(self) -> list[bytes]:
        bodies, place = [], 0
        while len(self._in) - place >= _HEAD.size:
            (length,) = _HEAD.unpack_from(self._in, place)
            if length > LONGEST:
                raise FrameError(f"frame of {length} bytes: at most {LONGEST} are allowed")
            end = place + _HEAD.size + length
            if len(self._in) < end:
                break
            bodies.append(bytes(self._in[place + _HEAD.size : end]))
            place = end
        del self._in[:place]
        return bodies
