"""Process that computes what clients of the dashboard ask for, so that neither requests nor estimates wait for it.

It starts with the first question and ends some minutes after the last. It speaks frames of MessagePack as a worker
does, at a lower priority than the workers, and has no access to the store.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import msgspec

from servotwin.errors import InvalidInput
from servotwin.messages import Refusal
from servotwin.runtime.frames import frame, read_frame
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.worker import WorkerLost, WorkerProcess, WorkerStart

_COMMAND = (sys.executable, "-m", "servotwin.twin_service.what_if_process")
_ANSWER_S, _IDLE_S, _LOOK_S = 10.0, 300.0, 15.0
"""s for one answer; s without a question after which the process ends; s between two looks."""
_WAITING = 8
"""Questions that may wait, beside the one that is answered."""
_NICENESS = 5
_SWITCH_S = 1e-3
"""s after which the thread of the maps lets the one that answers go on."""


class QuestionKind(StrEnum):
    """Kind of a question, and what its body holds.

    step: the body of the request, JSON; residual: a `StoredFit`, MessagePack; parquet: columns by name, MessagePack,
    which become a file.
    """

    STEP = "step"
    RESIDUAL = "residual"
    PARQUET = "parquet"


class WhatIfQuestion(NamedTuple):
    """A question about a servo.

    Attributes
    ----------
    servo : str
    body : bytes
    kind : QuestionKind
    """

    servo: str
    body: bytes
    kind: QuestionKind = QuestionKind.STEP


class WhatIfReply(NamedTuple):
    """Answer, JSON or a file, or in `error` why there is none."""

    answer: bytes
    error: str


_encode = msgspec.msgpack.Encoder().encode
_question = msgspec.msgpack.Decoder(WhatIfQuestion).decode
_reply = msgspec.msgpack.Decoder(WhatIfReply).decode


class WhatIfProcess:
    """The process, one question after the other.

    Parameters
    ----------
    start : WorkerStart
    monotonic : callable
        s.
    """

    def __init__(self, start: WorkerStart, monotonic: Callable[[], float]) -> None:
        self._start, self._monotonic = start, monotonic
        self._process: WorkerProcess | None = None
        self._turn, self._asked = asyncio.Lock(), 0
        self._used = monotonic()

    @property
    def pid(self) -> int | None:
        """Process id, while the process runs."""
        return None if self._process is None else self._process.pid

    async def answer(self, servo: str, body: bytes, kind: QuestionKind = QuestionKind.STEP) -> bytes:
        """Answer a question.

        Raises
        ------
        RequestRejected
            The question is not understood, too many wait, or its simulation takes too long.
        """
        if self._asked > _WAITING:
            raise RequestRejected(Refusal.TOO_MANY, "too many simulations are asked for now")
        self._asked += 1
        try:
            async with self._turn:
                reply = await self._replied(_encode(WhatIfQuestion(servo, body, kind)))
        finally:
            self._asked -= 1
            self._used = self._monotonic()
        if reply.error:
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, reply.error)
        return reply.answer

    async def run(self) -> None:
        """End the process whenever nobody has asked for a while."""
        while True:
            await asyncio.sleep(_LOOK_S)
            if self._process is not None and not self._asked and self._monotonic() - self._used > _IDLE_S:
                await self.stop()

    async def stop(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            await process.kill()

    async def _replied(self, question: bytes) -> WhatIfReply:
        try:
            process = await self._running()
            return _reply(await process.ask(question))
        except WorkerLost as lost:
            await self.stop()
            detail = f"the simulation gave no result: {lost}; ask for a shorter one"
            raise RequestRejected(Refusal.UNAVAILABLE, detail) from None
        except BaseException:
            # Its answer would be taken for that of the next question.
            await self.stop()
            raise

    async def _running(self) -> WorkerProcess:
        if self._process is None or self._process.pid is None:
            self._process = WorkerProcess(self._start, _ANSWER_S, _COMMAND)
            await self._process.start()
        return self._process


def main(descriptor: int) -> None:
    """Answer questions until the socket closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service ends this process
    with suppress(OSError):
        os.nice(_NICENESS)
    sys.setswitchinterval(_SWITCH_S)
    with socket.socket(fileno=descriptor) as line, line.makefile("rb") as stream:
        start = read_frame(stream)
        if start is None:
            return
        try:
            answer = _load(start)
        except InvalidInput as refusal:
            line.sendall(frame(str(refusal).encode()))
            return
        line.sendall(frame(b""))  # ready
        while (body := read_frame(stream)) is not None:
            line.sendall(frame(_encode(_replied(answer, _question(body)))))


def _replied(answer: Callable[[WhatIfQuestion], bytes], question: WhatIfQuestion) -> WhatIfReply:
    try:
        return WhatIfReply(answer(question), "")
    except InvalidInput as error:
        return WhatIfReply(b"", str(error))
    except Exception as failure:
        return WhatIfReply(b"", f"the simulation failed ({type(failure).__name__})")


def _load(start: bytes) -> Callable[[WhatIfQuestion], bytes]:
    from servotwin.dashboard.map_position import CoarseMaps
    from servotwin.dashboard.parquet_file import table_parquet
    from servotwin.dashboard.residual_view import StoredFit, residual_view
    from servotwin.dashboard.what_if import read_what_if, simulated_step
    from servotwin.twin.model_registry import ModelRegistry

    file = msgspec.msgpack.decode(start, type=WorkerStart)
    registry, maps = ModelRegistry.loads(file.text, file.source, Path(file.folder)), CoarseMaps()

    def answer(question: WhatIfQuestion) -> bytes:
        if question.kind is QuestionKind.PARQUET:
            return table_parquet(msgspec.msgpack.decode(question.body))
        if question.kind is QuestionKind.RESIDUAL:
            return msgspec.json.encode(residual_view(msgspec.msgpack.decode(question.body, type=StoredFit)))
        asked = read_what_if(question.body)
        return msgspec.json.encode(simulated_step(registry.model_of(question.servo), asked, maps))

    return answer


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)
