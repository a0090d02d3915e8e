"""Changes of the fleet, read in a process of its own: acknowledgements wait neither for a thread nor for a core.

It starts with the first page that watches, at a lower priority, and ends a minute after the last one. It only reads the
store. Until it is ready, and for a store in memory, a thread of the service reads.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import msgspec

from servotwin.runtime.frames import frame, read_frame
from servotwin.store.engine import StoreUnavailable, engines_of, parse_address
from servotwin.store.overview import StorePosition
from servotwin.store.store import Store
from servotwin.twin_service.fleet_reader import FleetReader
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.worker import StoreAddress, WorkerLost, WorkerProcess

log = logging.getLogger(__name__)

_COMMAND = (sys.executable, "-m", "servotwin.twin_service.fleet_process")
_ANSWER_S = 20.0
_NICENESS = 5


class ChangesQuestion(NamedTuple):
    """Changes since a position.

    Attributes
    ----------
    since : StorePosition
    names : tuple of str
        Servos whose rows are read in any case.
    connected : tuple of str
        Servos whose edges are connected.
    sole : bool
        All others are not.
    part, most : int
        Rows of one part, and of all.
    """

    since: StorePosition
    names: tuple[str, ...] = ()
    connected: tuple[str, ...] = ()
    sole: bool = False
    part: int = 1000
    most: int = 8000


class FleetChanges(NamedTuple):
    """Rows that changed.

    Attributes
    ----------
    position : StorePosition
        At which they were read.
    parts : tuple of bytes
        Lists of rows, JSON.
    many : bool
        More than the most changed: there are no parts.
    failed : bool
        The store could not be read.
    """

    position: StorePosition
    parts: tuple[bytes, ...] = ()
    many: bool = False
    failed: bool = False


_encode = msgspec.msgpack.Encoder().encode
_question = msgspec.msgpack.Decoder(ChangesQuestion).decode
_changes = msgspec.msgpack.Decoder(FleetChanges).decode


def read_changes(reader: FleetReader, question: ChangesQuestion) -> FleetChanges:
    """Read the rows that changed, and encode them once for all who watch; raises StoreUnavailable."""
    changed, position = reader.changed(question.since, question.most + 1)
    names = sorted({*changed, *question.names})
    if len(names) > question.most:
        return FleetChanges(position, many=True)
    firsts = range(0, len(names), question.part)
    parts = (msgspec.json.encode(reader.rows(names[first : first + question.part])) for first in firsts)
    return FleetChanges(position, tuple(parts))


class ChangeReader:
    """Reads changes, in the process while it runs.

    Parameters
    ----------
    reader : FleetReader
    executor : StoreExecutor
        For reading in a thread.
    address : str, optional
        URL of the store, with its password; absent: only a thread reads.
    """

    def __init__(self, reader: FleetReader, executor: StoreExecutor, address: str | None = None) -> None:
        self._reader, self._executor, self._address = reader, executor, address
        self._process: WorkerProcess | None = None
        self._starting: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()

    @property
    def pid(self) -> int | None:
        """Process id, once the process answers."""
        return None if self._process is None else self._process.pid

    async def position(self) -> StorePosition:
        """Present position; raises StoreUnavailable."""
        return await self._executor.run(self._reader.position)

    async def read(self, question: ChangesQuestion) -> FleetChanges:
        """Read what changed; raises StoreUnavailable."""
        if self._process is not None:
            try:
                async with self._turn:
                    found = _changes(await self._process.ask(_encode(question)))
            except WorkerLost as lost:
                log.warning("the process that reads changes was lost", extra={"why": str(lost)})
                await self.stop()
            except BaseException:
                await self.stop()  # its answer would be taken for that of the next question
                raise
            else:
                if not found.failed:
                    return found
                # Read here too: damage that only the other process has met would stop nothing.
        return await self._executor.run(partial(read_changes, self._reader, question))

    def start(self) -> None:
        """Have the process started, unless it runs; until it answers, `read` reads in a thread."""
        if self._address is not None and self._process is None and self._starting is None:
            self._starting = asyncio.create_task(self._start(self._address))

    async def _start(self, address: str) -> None:
        process = WorkerProcess(StoreAddress(address), _ANSWER_S, _COMMAND)
        try:
            await process.start()
            self._process = process
        except WorkerLost as lost:
            log.warning("the process that reads changes did not start", extra={"why": str(lost)})
            await process.kill()
        except asyncio.CancelledError:
            await process.kill()
            raise
        finally:
            self._starting = None

    async def stop(self) -> None:
        """End the process."""
        starting, process, self._process = self._starting, self._process, None
        if starting is not None:
            starting.cancel()
            await asyncio.gather(starting, return_exceptions=True)
        if process is not None:
            await process.kill()


def main(descriptor: int) -> None:
    """Answer questions until the socket closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service ends this process
    with suppress(OSError):
        os.nice(_NICENESS)
    with socket.socket(fileno=descriptor) as line, line.makefile("rb") as stream:
        start = read_frame(stream)
        if start is None:
            return
        store = Store(engines_of(parse_address(msgspec.msgpack.decode(start, type=StoreAddress).url)))
        line.sendall(frame(b""))  # ready
        while (body := read_frame(stream)) is not None:
            line.sendall(frame(_encode(_answer(store, _question(body)))))


def _answer(store: Store, question: ChangesQuestion) -> FleetChanges:
    connected, absent = frozenset(question.connected), False if question.sole else None
    reader = FleetReader(store, lambda servo: True if servo in connected else absent, time.time)
    try:
        store.learn_aside()
        return read_changes(reader, question)
    except StoreUnavailable:
        return FleetChanges(question.since, failed=True)


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)
