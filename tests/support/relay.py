"""A bad network between two processes on this machine: a TCP relay in a thread of its own.

It delays, cuts, stalls, and lets connections lie half open. What it does by chance comes from a seed, and the tests
decide nothing by the time that it takes.
"""

import asyncio
import socket
import struct
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from random import Random
from types import TracebackType
from typing import Any, NamedTuple, Self

Reader, Writer = asyncio.StreamReader, asyncio.StreamWriter
CHUNK = 65536
RESET = struct.pack("ii", 1, 0)
"""As SO_LINGER: closing resets the connection instead of ending it in good order."""


class State(StrEnum):
    """What the relay does with what it is given."""

    FLOWING = "flowing"
    STALLED = "stalled"
    HALF_OPEN = "half open"
    DOWN = "down"


class Weather(NamedTuple):
    """What happens by chance.

    Attributes
    ----------
    delay_s : (float, float)
        Every piece of data takes that long, evenly distributed; their order stays.
    cut_s : (float, float) or None
        All connections are cut after such a time, again and again.
    """

    delay_s: tuple[float, float] = (0.0, 0.0)
    cut_s: tuple[float, float] | None = None


class Relay:
    """Listens on a port of its own and passes on to `target`: a port of this machine, which may be set anew, or a path.

    Attributes
    ----------
    port : int
    counts : Counter
        What happened: "connection", "cut", "refused", "unreachable" ...
    """

    def __init__(self, target: int | Path, weather: Weather = Weather(), seed: int = 0) -> None:  # noqa: B008
        self.target, self.port = target, 0
        self.counts: Counter[str] = Counter()
        self._weather, self._random = weather, Random(seed)
        self._state = State.FLOWING
        self._writers: set[Writer] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._main()), name="relay")

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._ready.wait(10.0), "the relay did not start"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(10.0)

    def become(self, state: State) -> None:
        """From now on, for old and new connections; DOWN cuts the old ones and refuses new ones."""

        async def change() -> None:
            self._state = state
            if state is State.DOWN:
                self._abort()

        self._do(change())

    def clear(self) -> None:
        """From now on nothing bad happens by chance."""

        async def clear() -> None:
            self._weather = Weather()

        self._do(clear())

    def cut(self) -> int:
        """Cut all connections; returns how many halves there were."""

        async def cut() -> int:
            return self._abort()

        return self._do(cut())

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(10.0)

    def _abort(self) -> int:
        for writer in self._writers:
            with suppress(OSError):  # it may be closed already
                writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            writer.transport.abort()
        self.counts["cut"] += bool(self._writers)
        return len(self._writers)

    async def _main(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._begin, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        cutting = asyncio.create_task(self._cut_by_chance())
        self._ready.set()
        await self._stop.wait()
        cutting.cancel()
        self._abort()
        server.close()
        await finish(*asyncio.all_tasks() - {asyncio.current_task()})
        await server.wait_closed()
        await asyncio.sleep(0.01)  # what was aborted is closed in the loop's next rounds

    async def _cut_by_chance(self) -> None:
        while self._weather.cut_s is not None:
            await asyncio.sleep(self._random.uniform(*self._weather.cut_s))
            if self._weather.cut_s is not None:
                self._abort()

    def _begin(self, reader: Reader, writer: Writer) -> None:
        """A task of our own: asyncio's for a connection logs it as an error when it is cancelled in the end (3.11)."""
        task = asyncio.create_task(self._accept(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, reader: Reader, writer: Writer) -> None:
        self.counts["connection"] += 1
        self._writers.add(writer)
        try:
            if self._state is State.DOWN:
                self.counts["refused"] += 1
            else:
                await self.serve(reader, writer)
        except (OSError, EOFError, asyncio.CancelledError):  # cancelled at the end only
            self.counts["broken"] += 1
        finally:
            await self._let_go(writer)

    async def _let_go(self, writer: Writer) -> None:
        self._writers.discard(writer)
        writer.close()
        await quietly(asyncio.wait_for(writer.wait_closed(), 5.0))

    async def connected(self, use: Callable[[Reader, Writer], Awaitable[None]]) -> None:
        """A connection to the target, used and let go."""
        try:
            if isinstance(self.target, Path):
                reader, writer = await asyncio.open_unix_connection(self.target)
            else:
                reader, writer = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            self.counts["unreachable"] += 1
            return
        self._writers.add(writer)
        try:
            await use(reader, writer)
        finally:
            await self._let_go(writer)

    async def serve(self, reader: Reader, writer: Writer) -> None:
        """Pass on what one connection carries, both ways, until either end closes."""

        async def both(back: Reader, forth: Writer) -> None:
            pumps = [asyncio.create_task(self._pump(*ends)) for ends in ((reader, forth), (back, writer))]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                await finish(*pumps)

        await self.connected(both)

    async def _pump(self, reader: Reader, writer: Writer) -> None:
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(1000)
        writing = asyncio.create_task(self._write(pieces, writer))
        try:
            while data := await reader.read(CHUNK):
                await pieces.put((self._loop.time() + self._random.uniform(*self._weather.delay_s), data))
            await pieces.put((0.0, b""))
            await writing
        finally:
            await finish(writing)

    async def _write(self, pieces: "asyncio.Queue[tuple[float, bytes]]", writer: Writer) -> None:
        while (piece := await pieces.get())[1]:
            await asyncio.sleep(max(0.0, piece[0] - self._loop.time()))
            while self._state is State.STALLED:
                await asyncio.sleep(0.01)
            if self._state is State.HALF_OPEN:
                self.counts["swallowed"] += 1
                continue
            writer.write(piece[1])
            await writer.drain()


async def finish(*tasks: "asyncio.Task[Any] | None") -> None:
    """Cancel what still runs, wait for it, and fetch what it raised: a broken connection is no news here."""
    for task in tasks:
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
            if not task.cancelled():
                task.exception()


async def quietly(work: Awaitable[Any]) -> None:
    """Do it; a broken connection is no news here."""
    try:
        await work
    except (OSError, EOFError):
        return
