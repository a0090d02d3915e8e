"""Many simulated servos of `servotwin bench endurance` in one process, over the twin's real HTTP interface.

`python -m benchmarks.endurance_crowd PLAN` serves the servos of a plan until a file `stop` beside it tells that no more
windows shall be cut, and all are sent. Each servo keeps what the twin has not acknowledged, and sends it again. What is
acknowledged goes into a file that outlives a kill. Like an edge, it imports no numerical library.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

import msgspec
from msgspec import Struct

from benchmarks.fleet.line import HttpConnection
from servotwin.link.seal import Sealed
from servotwin.messages import Hello, Reason, Receipt, Setting, Update, WindowMessage, decode, encode
from servotwin.messages.codec import deflated
from servotwin.runtime.files import replace_file

ACKNOWLEDGED, STATUS, STOP = "crowd-acknowledged", "crowd-status.json", "stop"
_TAKEN, _PUT_OFF = (200, 201, 202), (422, 429, 503)
_PAUSE_S, _LOOK_S, _ANSWER_S = 1.0, 0.05, 60.0
_sealed = msgspec.msgpack.Decoder(list[bytes])


class CrowdPlan(Struct, frozen=True):
    """What the process of the crowd has to do.

    Attributes
    ----------
    port : int
    tokens : dict of str to str
        Of each servo.
    period : float
        s from one window of a servo to the next.
    connections : int
    templates : tuple of bytes
        Windows that are readdressed.
    """

    port: int
    tokens: dict[str, str]
    period: float
    connections: int
    templates: tuple[bytes, ...]


class CrowdStatus(Struct, frozen=True):
    """Numbers of a crowd: windows that wait, updates applied, and messages refused for good, by status."""

    waiting: int
    applied: int
    refused: dict[str, int]


class _Cut(NamedTuple):
    """A window that waits: sequence, version in force when it was cut, and start, s of sample time."""

    sequence: int
    version: int
    start: float


class PutOff(Exception):
    """The twin refused a message for now."""


@dataclass
class CrowdServo:
    """One servo: what it has cut and sent.

    Attributes
    ----------
    due : float
        s, when the next window is cut.
    waiting : deque
        Windows without an acknowledgement.
    """

    name: str
    token: str
    boot: str
    due: float
    templates: tuple[WindowMessage, ...]
    sequence: int = 0
    version: int = 0
    serial: int = 0
    greeted: bool = False
    receipts: deque[bytes] = field(default_factory=deque)
    waiting: deque[_Cut] = field(default_factory=deque)

    @property
    def idle(self) -> bool:
        """True where nothing is to be sent."""
        return self.greeted and not self.receipts and not self.waiting

    def cut(self, now: float, period: float) -> None:
        """Cut the windows that are due at `now`, s since the start of the process."""
        while self.due <= now:
            self.waiting.append(_Cut(self.sequence, self.version, self.due))
            self.sequence, self.due = self.sequence + 1, self.due + period

    def window(self, cut: _Cut) -> tuple[bytes, str]:
        """Body and encoding of a window: the same bytes each time that it is sent."""
        template = self.templates[cut.sequence % len(self.templates)]
        shift = cut.start - template.start
        changes = tuple((time + shift, value) for time, value in template.reference_changes)
        made = msgspec.structs.replace(
            template,
            servo=self.name,
            boot=self.boot,
            sequence=cut.sequence,
            start=cut.start,
            parameter_version=cut.version,
            reference_changes=changes,
        )
        return deflated(encode(made))

    def hello(self) -> bytes:
        """The first letter of this start."""
        template = self.templates[0]
        return encode(
            Hello(self.name, self.boot, 0.0, template.rate, self.version, Setting(0.0), template.model_version)
        )

    def apply(self, body: bytes) -> int:
        """Apply the updates among the twin's messages at once; their number."""
        applied = 0
        for each in _sealed.decode(body):
            sealed = msgspec.msgpack.decode(each, type=Sealed)
            self.serial = max(self.serial, sealed.serial)
            message = decode(sealed.body)
            if isinstance(message, Update) and message.version > self.version:
                self.version, applied = message.version, applied + 1
                receipt = Receipt(self.name, message.version, True, 1, Reason.APPLIED, message.version, self.boot)
                self.receipts.append(encode(receipt))
        return applied


class Crowd:
    """All servos of one start of the process.

    Parameters
    ----------
    plan : CrowdPlan
    folder : Path
        Where the files of the crowd are.
    boot : str
    """

    def __init__(self, plan: CrowdPlan, folder: Path, boot: str) -> None:
        self.plan, self.folder = plan, folder
        templates = tuple(_window(body) for body in plan.templates)
        count = len(plan.tokens)
        self.servos = [
            CrowdServo(name, token, boot, plan.period * number / count, templates)
            for number, (name, token) in enumerate(plan.tokens.items())
        ]
        self.applied, self.refused = 0, Counter[str]()

    async def run(self) -> None:
        """Serve all servos until they are told to stop, and all is sent."""
        begun, groups = time.monotonic(), min(self.plan.connections, len(self.servos))
        with (self.folder / ACKNOWLEDGED).open("a", encoding="ascii") as log:
            served = (self._serve(self.servos[n::groups], begun, log) for n in range(groups))
            status = asyncio.create_task(self._write_status())
            await asyncio.gather(*served)
            status.cancel()
        self.note()

    def note(self) -> None:
        """Write the status."""
        status = CrowdStatus(sum(len(servo.waiting) for servo in self.servos), self.applied, dict(self.refused))
        replace_file(self.folder / STATUS, msgspec.json.encode(status))

    async def _write_status(self) -> None:
        while True:
            self.note()
            await asyncio.sleep(_PAUSE_S)

    async def _serve(self, servos: list[CrowdServo], begun: float, log: IO[str]) -> None:
        """Serve some servos over one connection, which is opened again wherever it breaks."""
        line: CrowdLine | None = None
        while True:
            stopping = (self.folder / STOP).exists()
            if not stopping:
                for servo in servos:
                    servo.cut(time.monotonic() - begun, self.plan.period)
            busy = [servo for servo in servos if not servo.idle]
            if stopping and not busy:
                break
            try:
                line = line or await CrowdLine.opened(self.plan.port)
                for servo in busy:
                    await self._turn(servo, line, log)
            except PutOff:
                await asyncio.sleep(_PAUSE_S)
            except (OSError, TimeoutError):
                if line is not None:
                    line.close()
                line = None
                await asyncio.sleep(_PAUSE_S)
            await asyncio.sleep(_LOOK_S)
        if line is not None:
            line.close()

    async def _turn(self, servo: CrowdServo, line: CrowdLine, log: IO[str]) -> None:
        """Send a servo's letters and windows, and take what the twin has for it."""
        path = f"/v1/servos/{servo.name}"
        if not servo.greeted:
            await self._send(line, servo, "POST", f"{path}/letters", servo.hello())
            servo.greeted = True
        status, body = await line.ask(_head(servo, "GET", f"{path}/outgoing?after={servo.serial}&wait=0"), b"")
        if status == 200:
            self.applied += servo.apply(body)
        while servo.receipts:
            await self._send(line, servo, "POST", f"{path}/letters", servo.receipts[0])
            servo.receipts.popleft()
        while servo.waiting:
            cut = servo.waiting[0]
            if await self._send(line, servo, "PUT", f"{path}/windows/{servo.boot}/{cut.sequence}", *servo.window(cut)):
                log.write(f"{servo.name} {servo.boot} {cut.sequence}\n")
                log.flush()  # before it is forgotten here
            servo.waiting.popleft()

    async def _send(
        self, line: CrowdLine, servo: CrowdServo, method: str, path: str, body: bytes, encoding: str = ""
    ) -> bool:
        """Send a message; False where the twin refuses it for good. Raises PutOff."""
        status, _ = await line.ask(_head(servo, method, path, encoding), body)
        if status in _PUT_OFF:
            raise PutOff
        if status not in _TAKEN:
            self.refused[str(status)] += 1
        return status in _TAKEN


class CrowdLine:
    """A connection to the twin, one request at a time."""

    def __init__(self) -> None:
        self._answer: asyncio.Future[tuple[int, bytes]] | None = None
        self._connection = HttpConnection(self._broken)

    @classmethod
    async def opened(cls, port: int) -> CrowdLine:
        """Open a connection; raises OSError."""
        line = cls()
        await asyncio.get_running_loop().create_connection(lambda: line._connection, "127.0.0.1", port)
        return line

    async def ask(self, head: bytes, body: bytes) -> tuple[int, bytes]:
        """Send a request; return status and body of its response. Raises OSError or TimeoutError."""
        if self._connection.closed:
            raise ConnectionError("the connection is closed")
        answer: asyncio.Future[tuple[int, bytes]] = asyncio.get_running_loop().create_future()
        self._answer = answer
        self._connection.ask(head, body, self._answered)
        async with asyncio.timeout(_ANSWER_S):
            return await answer

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _answered(self, status: int, body: bytes) -> None:
        if self._answer is not None and not self._answer.done():
            self._answer.set_result((status, body))

    def _broken(self, why: str) -> None:
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(ConnectionError(why))


def _head(servo: CrowdServo, method: str, path: str, encoding: str = "") -> bytes:
    coded = f"Content-Encoding: {encoding}\r\n" if encoding else ""
    return f"{method} {path} HTTP/1.1\r\nHost: twin\r\nAuthorization: Bearer {servo.token}\r\n{coded}".encode()


def _window(body: bytes) -> WindowMessage:
    message = decode(body)
    assert isinstance(message, WindowMessage)
    return message


if __name__ == "__main__":
    file = Path(sys.argv[1])
    given = msgspec.msgpack.decode(file.read_bytes(), type=CrowdPlan)
    asyncio.run(Crowd(given, file.parent, f"c-{os.urandom(6).hex()}").run())
