"""Link with outages: connections are forwarded to the twin, and cut on a schedule."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import NamedTuple

from servotwin.errors import InvalidInput

_CHECK_S = 0.1
_CHUNK = 65536


class Outages(NamedTuple):
    """Schedule of the outages, s since the start; none comes before the first updates could be applied.

    Attributes
    ----------
    first, lasting, every : float
        Start of the first outage, duration of each, period.
    """

    first: float = 20.0
    lasting: float = 8.0
    every: float = 40.0

    def left(self, time: float) -> float:
        """s until the present outage ends; 0: there is none."""
        since = time - self.first
        return max(0.0, self.lasting - since % self.every) if since >= 0.0 else 0.0


class Forwarder:
    """Forwards connections from a port of its own, except in outages.

    Parameters
    ----------
    target : int
        Local port that connections are forwarded to.
    outages : Outages

    Attributes
    ----------
    port : int
        Port that it listens on.
    """

    def __init__(self, target: int, outages: Outages) -> None:
        self._target, self._outages = target, outages
        self.port = 0
        self._writers: set[asyncio.StreamWriter] = set()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._main()), name="forwarder", daemon=True)

    def start(self) -> None:
        """Start to listen; returns when it does.

        Raises
        ------
        InvalidInput
            No port is available.
        """
        self._thread.start()
        while not self._ready.wait(0.1):
            if not self._thread.is_alive():
                raise InvalidInput("the link with outages cannot listen on 127.0.0.1")

    def stop(self) -> None:
        """Cut all connections and stop listening."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join()

    @property
    def left(self) -> float:
        """s until the present outage ends; 0: there is none."""
        return self._outages.left(self._loop.time() - self._zero)

    async def _main(self) -> None:
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        self._zero = self._loop.time()
        server = await asyncio.start_server(self._forward, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        async with server:
            while not self._stopping.is_set():
                if self.left:
                    self._cut()
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._stopping.wait(), _CHECK_S)
            self._cut()

    def _cut(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.left:
            writer.transport.abort()  # a reset, as of a cut link; a close would look like an orderly end
            return
        try:
            target_reader, target_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        writers = {writer, target_writer}
        self._writers |= writers
        try:
            await asyncio.gather(_pump(reader, target_writer), _pump(target_reader, writer))
        finally:
            self._writers -= writers
            for each in writers:
                each.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()
        writer.write_eof()
