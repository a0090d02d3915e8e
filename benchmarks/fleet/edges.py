"""The edges of a whole fleet in one process: windows fall due, go out, and updates are answered.

`python -m benchmarks.fleet.edges LOAD` runs the plan in the file, writes a report to its output, and ends. Like an
edge, it imports no numerical library.
"""

from __future__ import annotations

import asyncio
import sys
import time
from pathlib import Path

import msgspec

from benchmarks.fleet.edge_load import EdgeLoad, LoadCounts, LoadEdge
from benchmarks.fleet.line import HttpConnection
from benchmarks.fleet.plan import LoadPlan, LoadReport, LoadStart, decode_load, shares
from servotwin.link.http import WAITING
from servotwin.messages import encode

TAKEN, LATER = (200, 201, 202), (429, 503)
PAUSE = 0.2
"""s after which a request that was put off is made again."""
PATIENCE, ANSWER_S = 600.0, 120.0
"""s that windows may wait once no more fall due, and that a turn may take."""


class EdgeTurn:
    """One servo's turn on one connection: poll, answer, send the window."""

    def __init__(self, fleet: EdgeLoad, line: HttpConnection, done: asyncio.Event, failed: list[str]) -> None:
        self.fleet, self.line, self.done, self.failed = fleet, line, done, failed
        self.edge, self.sent, self.body = fleet.edges[0], 0.0, b""

    def begin(self, edge: LoadEdge) -> None:
        """Start with the poll, where there is one; then the window that the edge has on its way."""
        self.edge, self.body = edge, b""
        if self.fleet.plan.polls:
            self.fleet.counts.polls += 1
            self.line.ask(_head("GET", f"{_servo(edge)}/outgoing?after={edge.serial}&wait=0"), b"", self._polled)
        else:
            self._put()

    def _polled(self, status: int, body: bytes) -> None:
        if self._bad(status):
            return
        self.fleet.apply_messages(self.edge, body)
        self._answer()

    def _answer(self, status: int = 202, _body: bytes = b"") -> None:
        if self._bad(status):
            return
        if not self.edge.receipts:
            self._put()
            return
        receipt = self.edge.receipts.pop(0)
        self.line.ask(_head("POST", f"{_servo(self.edge)}/letters"), encode(receipt), self._answer)

    def _put(self) -> None:
        edge, counts, sending = self.edge, self.fleet.counts, self.edge.on_its_way
        assert sending is not None
        self.sent = time.monotonic()
        self.body = self.fleet.window(edge, *sending)
        if self.fleet.undisturbed(self.sent):
            counts.late.append(self.sent - sending.due)
        path = f"{_servo(edge)}/windows/{self.fleet.plan.boot}/{sending.sequence}"
        more = f"{WAITING}: {len(edge.waiting)}\r\n".encode() if edge.waiting else b""
        self.line.ask(_head("PUT", path) + more, self.body, self._taken)

    def _taken(self, status: int, _body: bytes) -> None:
        if self._bad(status):
            return
        counts, now = self.fleet.counts, time.monotonic()
        counts.windows, counts.bytes = counts.windows + 1, counts.bytes + len(self.body)
        counts.latency.append(now - self.sent)
        if not self.fleet.undisturbed(self.sent):
            counts.latency_after.append(now - self.sent)
        self.fleet.taken(self.edge, now, self.line.older_pause)
        self.done.set()

    def _bad(self, status: int) -> bool:
        """Handle an unexpected status; True: the turn ends, to be repeated or with the whole run."""
        if status in TAKEN:
            return False
        if status in LATER:
            self.fleet.counts.later += 1
            self.fleet.requeue(self.edge)
        else:
            self.failed.append(f"the twin answered {status} to {self.edge.name}")
        self.done.set()
        return True


async def run(load: LoadStart) -> LoadReport:
    """Run a plan.

    Raises
    ------
    RuntimeError
        The twin answered what it never should, or went away.
    """
    fleet, failed = EdgeLoad(load, time.monotonic()), list[str]()
    # No servo has two windows on their way at once.
    turns = [await _connected(fleet, failed) for _ in range(min(load.plan.connections, load.plan.servos // 2 or 1))]
    fleet.begin = time.monotonic()
    clock = asyncio.create_task(_ticks(fleet))
    try:
        await asyncio.gather(*(_serve(turn) for turn in turns))
    finally:
        clock.cancel()
        for turn in turns:
            turn.line.close()
    if failed:
        raise RuntimeError(failed[0])
    return _report(fleet.counts, time.monotonic() - fleet.begin)


async def _connected(fleet: EdgeLoad, failed: list[str]) -> EdgeTurn:
    """Open a connection for one turn at a time."""
    done = asyncio.Event()
    return EdgeTurn(fleet, await _line(fleet.plan, done, failed), done, failed)


async def _line(plan: LoadPlan, done: asyncio.Event, failed: list[str]) -> HttpConnection:
    """Open a connection to the twin; the run ends if it breaks while an answer is due."""

    def broken(why: str) -> None:
        failed.append(why)
        done.set()

    _, line = await asyncio.get_running_loop().create_connection(lambda: HttpConnection(broken), "127.0.0.1", plan.port)
    return line


async def _ticks(fleet: EdgeLoad) -> None:
    while True:
        fleet.add_due(time.monotonic())
        await asyncio.sleep(0.005)


async def _serve(turn: EdgeTurn) -> None:
    """Use one connection until nothing is left to do."""
    fleet, plan = turn.fleet, turn.fleet.plan
    while not turn.failed:
        now = time.monotonic()
        over = now - fleet.begin >= plan.duration
        next_one = fleet.take(now)
        if next_one is None:
            if over and (fleet.waiting == 0 or now - fleet.begin > plan.duration + PATIENCE):
                return
            if fleet.cut(now):
                turn.line.close()
            await asyncio.sleep(0.01)
            continue
        if turn.line.closed:
            turn.line = await _line(plan, turn.done, turn.failed)
        turn.done.clear()
        before = fleet.counts.later
        turn.begin(next_one)
        try:
            async with asyncio.timeout(ANSWER_S):
                await turn.done.wait()
        except TimeoutError:
            turn.failed.append(f"no answer from the twin within {ANSWER_S:g} s")
        if fleet.counts.later > before:
            await asyncio.sleep(PAUSE)


def _report(counts: LoadCounts, seconds: float) -> LoadReport:
    used = time.process_time()
    return LoadReport(
        seconds=seconds,
        windows=counts.windows,
        news=counts.news,
        polls=counts.polls,
        updates=counts.updates,
        later=counts.later,
        bytes=counts.bytes,
        cpu=used,
        latency=shares(counts.latency),
        latency_after=shares(counts.latency_after),
        late=shares(counts.late),
        waited=counts.waited,
    )


def _servo(edge: LoadEdge) -> str:
    return f"/v1/servos/{edge.name}"


def _head(method: str, path: str) -> bytes:
    return f"{method} {path} HTTP/1.1\r\nHost: twin\r\n".encode()


if __name__ == "__main__":
    given = decode_load(Path(sys.argv[1]).read_bytes())
    sys.stdout.buffer.write(msgspec.json.encode(asyncio.run(run(given))))
