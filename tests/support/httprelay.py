"""A bad network for HTTP requests: each may be lost before or after the server saw it, arrive twice, late, overtaken.

What happens to a request depends on the seed, its method and path, and how often it was sent, not on when it comes.
"""

import asyncio
from random import Random
from typing import NamedTuple
from urllib.parse import urlsplit

from relay import Reader, Relay, Weather, Writer, quietly

LONGEST = 1 << 26


class Chances(NamedTuple):
    """Probabilities per request, and times.

    Attributes
    ----------
    lost_before, lost_after : float
        It never reaches the server; the server has it, but its answer is lost.
    twice : float
        It reaches the server a second time, a while after the first.
    held : float
        It waits for up to `hold_s` first, so that later ones overtake it.
    delay_s : (float, float)
        Each way, evenly distributed.
    hold_s : float
    """

    lost_before: float = 0.0
    lost_after: float = 0.0
    twice: float = 0.0
    held: float = 0.0
    delay_s: tuple[float, float] = (0.0, 0.0)
    hold_s: float = 1.0


class Fate(NamedTuple):
    """What happens to one request."""

    lost_before: bool
    lost_after: bool
    twice: bool
    wait_s: float
    back_s: float
    again_s: float


def fate_of(request: str, times: int, chances: Chances, seed: int) -> Fate:
    """What happens to a request ("PUT /path") that is sent for the `times`-th time."""
    random = Random(f"{seed} {times} {request}")
    before, after, twice, held = (random.random() < chances[k] for k in range(4))
    wait, back, again = random.uniform(*chances.delay_s), random.uniform(*chances.delay_s), random.random()
    hold = random.random() * chances.hold_s if held else 0.0
    return Fate(before, after, twice, wait + hold, back, again * chances.hold_s)


class HttpRelay(Relay):
    """One request a connection; counts what it did to them, by kind."""

    def __init__(self, target: int, chances: Chances = Chances(), seed: int = 0, weather: Weather = Weather()) -> None:  # noqa: B008
        super().__init__(target, weather, seed)
        self.chances, self._seed = chances, seed
        self._late: set[asyncio.Task[None]] = set()

    def clear(self) -> None:
        """From now on nothing bad happens."""

        async def clear() -> None:
            self.chances = Chances()

        super().clear()
        self._do(clear())

    async def serve(self, reader: Reader, writer: Writer) -> None:
        """Take a request and do to it what its fate says."""
        head = await reader.readuntil(b"\r\n\r\n")
        request = head + await body_of(head, reader)
        method, path, _ = head.split(b"\r\n", 1)[0].decode().split(" ", 2)
        name = f"{method} {urlsplit(path).path}"
        self.counts[name] += 1
        fate = fate_of(name, self.counts[name], self.chances, self._seed)
        await asyncio.sleep(fate.wait_s)
        if fate.lost_before:
            self.counts["lost before"] += 1
            return
        self.counts["held"] += fate.wait_s > self.chances.delay_s[1]
        if fate.twice:
            self._again(request, fate.again_s)
        answer = await self._ask(request)
        await asyncio.sleep(fate.back_s)
        if fate.lost_after:
            self.counts["lost after"] += 1
            return
        writer.write(answer)
        await writer.drain()
        writer.write_eof()
        await reader.read()

    def _again(self, request: bytes, wait: float) -> None:
        async def later() -> None:
            await asyncio.sleep(wait)
            await quietly(self._ask(request))

        self.counts["twice"] += 1
        task = asyncio.create_task(later())
        self._late.add(task)
        task.add_done_callback(self._late.discard)

    async def _ask(self, request: bytes) -> bytes:
        """The whole answer; empty when there is none."""
        answer = bytearray()

        async def ask(back: Reader, forth: Writer) -> None:
            forth.write(closing(request))
            await forth.drain()
            while piece := await back.read(1 << 16):
                answer.extend(piece)

        await self.connected(ask)
        return bytes(answer)


def closing(request: bytes) -> bytes:
    """The request, asking the server to close the connection after it."""
    head, body = request.split(b"\r\n\r\n", 1)
    lines = [line for line in head.split(b"\r\n") if not line.lower().startswith(b"connection:")]
    return b"\r\n".join([*lines, b"Connection: close"]) + b"\r\n\r\n" + body


async def body_of(head: bytes, reader: Reader) -> bytes:
    """What follows a request's head."""
    fields = dict(line.lower().split(b":", 1) for line in head.split(b"\r\n")[1:] if b":" in line)
    if b"chunked" in fields.get(b"transfer-encoding", b""):
        return await _chunks(reader)
    return await reader.readexactly(min(int(fields.get(b"content-length", 0)), LONGEST))


async def _chunks(reader: Reader) -> bytes:
    taken = bytearray()
    while True:
        line = await reader.readuntil(b"\r\n")
        size = int(line.split(b";")[0], 16)
        taken += line + await reader.readexactly(size + 2)
        if size == 0:
            return bytes(taken)
