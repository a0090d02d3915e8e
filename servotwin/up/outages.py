"""A link with outages: connections are passed on to the twin, and cut on a schedule."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import NamedTuple

from servotwin.errors import InvalidInput

LOOK_S = 0.1
_PIECE = 65536


class Outages(NamedTuple):
    """When the link is cut, s since it began.

    Attributes
    ----------
    first, lasting, every : float
        The first outage, how long each lasts, and from one to the next.
    """

    first: float = 6.0
    lasting: float = 8.0
    every: float = 40.0

    def left(self, time: float) -> float:
        """s until the present outage is over; 0: there is none."""
        since = time - self.first
        return max(0.0, self.lasting - since % self.every) if since >= 0.0 else 0.0


class Forwarder:
    """Listens on a port of its own and passes connections on, but in outages.

    Parameters
    ----------
    target : int
        Port of this machine, where connections go.
    outages : Outages

    Attributes
    ----------
    port : int
        Where it listens.
    """

    def __init__(self, target: int, outages: Outages) -> None:
        self._target, self._outages = target, outages
        self.port = 0
        self._writers: set[asyncio.StreamWriter] = set()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._main()), name="forwarder", daemon=True)

    def begin(self) -> None:
        """Listen; returns when it does.

        Raises
        ------
        InvalidInput
            The system gives no port.
        """
        self._thread.start()
        while not self._ready.wait(0.1):
            if not self._thread.is_alive():
                raise InvalidInput("the link with outages cannot listen on 127.0.0.1")

    def end(self) -> None:
        """Cut everything, and stop listening."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()

    @property
    def left(self) -> float:
        """s until the present outage is over; 0: there is none."""
        return self._outages.left(self._loop.time() - self._zero)

    async def _main(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._zero = self._loop.time()
        server = await asyncio.start_server(self._pass_on, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        async with server:
            while not self._stop.is_set():
                if self.left:
                    self._cut()
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._stop.wait(), LOOK_S)
            self._cut()

    def _cut(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.left:
            writer.transport.abort()
            return
        try:
            onward = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        mine = {writer, onward[1]}
        self._writers |= mine
        try:
            await asyncio.gather(_pump(reader, onward[1]), _pump(onward[0], writer))
        finally:
            self._writers -= mine
            for each in mine:
                each.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_PIECE):
            writer.write(data)
            await writer.drain()
        writer.write_eof()
