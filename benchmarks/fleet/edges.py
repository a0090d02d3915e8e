"""The edges of a whole fleet in one process: windows fall due, go out, and updates are answered.

`python -m benchmarks.fleet.edges LOAD` runs the plan in the file, writes a report to its output, and ends. Like an
edge, it imports no numerical library.
"""

from __future__ import annotations

import asyncio
import random
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from benchmarks.fleet.line import HttpConnection
from benchmarks.fleet.plan import LoadPlan, LoadReport, LoadStart, decode_load, shares
from servotwin.link.seal import Sealed
from servotwin.messages import Reason, Receipt, Update, WindowMessage, decode, encode

TAKEN, LATER = (200, 201, 202), (429, 503)
FRESH_S = 10.0
"""s after the end of an outage after which the newest windows go first, as `servotwin.link.session` has it."""
PAUSE = 0.2
"""s after which a request that was put off is made again."""
PATIENCE, ANSWER_S = 600.0, 120.0
"""s that windows may wait once no more fall due, and that a turn may take."""

_sealed = msgspec.msgpack.Decoder(list[bytes])


@dataclass
class LoadEdge:
    """One servo.

    Attributes
    ----------
    name : str
    place, tuned : int
        Index of its gap in the stock, and of the gap that the parameters in force are for.
    version, sequence, serial : int
        Of the parameters in force, of its next window, of the last message that it took.
    receipts : list of Receipt
        Not yet sent.
    """

    name: str
    place: int
    tuned: int
    version: int
    sequence: int = 0
    serial: int = 0
    receipts: list[Receipt] = field(default_factory=list)


@dataclass
class LoadCounts:
    """Counters that become a `LoadReport`."""

    windows: int = 0
    news: int = 0
    polls: int = 0
    updates: int = 0
    later: int = 0
    bytes: int = 0
    waited: int = 0
    latency: list[float] = field(default_factory=list)
    late: list[float] = field(default_factory=list)


class EdgeLoad:
    """All servos, and what falls due.

    Parameters
    ----------
    load : LoadStart
    clock : callable
        s, that never steps.
    """

    def __init__(self, load: LoadStart, now: float) -> None:
        self.plan, self.begin = load.plan, now
        self.places = [[_window(body) for body in place.windows] for place in load.places]
        self.moved = [_window(place.moved) for place in load.places]
        self.gaps, versions = [place.gap for place in load.places], [place.version for place in load.places]
        self.chance = random.Random(load.plan.seed)
        plan, count = load.plan, len(self.places)
        self.edges = [LoadEdge(f"ax-{n:05d}", n % count, n % count, versions[n % count]) for n in range(plan.servos)]
        self.counts = LoadCounts()
        self._issued, self._refreshed = 0, False
        self._pending: deque[tuple[LoadEdge, float]] = deque()

    @property
    def waiting(self) -> int:
        """Windows that are due and not sent."""
        return len(self._pending)

    def add_due(self, now: float) -> None:
        """Queue the windows whose time has come."""
        plan, since = self.plan, now - self.begin
        most = min(int(since * plan.rate) + 1, round(plan.duration * plan.rate)) if plan.rate > 0.0 else 0
        while self._issued < most:
            edge = self.edges[self._issued % plan.servos]
            self._pending.append((edge, self.begin + self._issued / plan.rate))
            self._issued += 1
        self.counts.waited = max(self.counts.waited, len(self._pending))

    def take(self, now: float) -> tuple[LoadEdge, float] | None:
        """Take the next window to be sent, and its due time; None: not now."""
        plan, since = self.plan, now - self.begin
        if self.cut(now):
            return None
        if not self._refreshed and 0.0 < plan.outage[1] <= since - FRESH_S:
            self._refresh()
        if self._pending:
            return self._pending.popleft()
        if plan.rate == 0.0:
            if since >= plan.duration:
                return None
            self._issued += 1
            return self.edges[(self._issued - 1) % plan.servos], now
        return None

    def cut(self, now: float) -> bool:
        """Test for an outage that has cut every connection."""
        return self.plan.outage[0] <= now - self.begin < self.plan.outage[1]

    def _refresh(self) -> None:
        """Put the newest window of each servo first, as an edge does whose backlog has taken long."""
        newest: dict[str, tuple[LoadEdge, float]] = {edge.name: (edge, due) for edge, due in self._pending}
        rest = [(edge, due) for edge, due in self._pending if newest[edge.name][1] != due]
        self._pending, self._refreshed = deque([*newest.values(), *rest]), True

    def requeue(self, edge: LoadEdge, due: float) -> None:
        """Put a postponed window back."""
        self._pending.appendleft((edge, due))

    def window(self, edge: LoadEdge, due: float) -> bytes:
        """Encoded window of the edge's source, readdressed; sometimes the gap has moved to that of the next source.

        Until the edge applies an update for that gap its windows are of the setting before.
        """
        if self.plan.news > 0.0 and self.chance.random() < self.plan.news:
            edge.place = (edge.place + 1) % len(self.places)
            self.counts.news += 1
        made = self.places[edge.place] if edge.tuned == edge.place else [self.moved[edge.place - 1]]
        template = made[edge.sequence % len(made)]
        start = self.plan.start + (due - self.begin)
        shift = start - template.start
        changes = tuple((time + shift, value) for time, value in template.reference_changes)
        return encode(
            msgspec.structs.replace(
                template,
                servo=edge.name,
                boot=self.plan.boot,
                sequence=edge.sequence,
                start=start,
                parameter_version=edge.version,
                reference_changes=changes,
            )
        )

    def apply_messages(self, edge: LoadEdge, body: bytes) -> None:
        """Handle messages of the twin: apply an update at once, and queue its receipt."""
        for each in _sealed.decode(body):
            sealed = msgspec.msgpack.decode(each, type=Sealed)
            edge.serial = max(edge.serial, sealed.serial)
            message = decode(sealed.body)
            if isinstance(message, Update) and message.version > edge.version:
                edge.version = message.version
                edge.tuned = self._place_of(message.gap)
                self.counts.updates += 1
                receipt = Receipt(edge.name, message.version, True, 1, Reason.APPLIED, message.version, self.plan.boot)
                edge.receipts.append(receipt)

    def _place_of(self, gap: float | None) -> int:
        """Index of the place whose gap (rad) is the nearest."""
        assert gap is not None
        return min(range(len(self.gaps)), key=lambda n: abs(self.gaps[n] - gap))

    def undisturbed(self, now: float) -> bool:
        """Test that no outage has begun by `now`."""
        begin, end = self.plan.outage
        return begin == end or now - self.begin < begin


class EdgeTurn:
    """One servo's turn on one connection: poll, answer, send the window."""

    def __init__(self, fleet: EdgeLoad, line: HttpConnection, done: asyncio.Event, failed: list[str]) -> None:
        self.fleet, self.line, self.done, self.failed = fleet, line, done, failed
        self.edge, self.due, self.sent, self.body = fleet.edges[0], 0.0, 0.0, b""

    def begin(self, edge: LoadEdge, due: float) -> None:
        """Start with the poll, where there is one."""
        self.edge, self.due, self.body = edge, due, b""
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
        edge, counts = self.edge, self.fleet.counts
        self.sent = time.monotonic()
        self.body = self.fleet.window(edge, self.due)
        if self.fleet.undisturbed(self.sent):
            counts.late.append(self.sent - self.due)
        path = f"{_servo(edge)}/windows/{self.fleet.plan.boot}/{edge.sequence}"
        self.line.ask(_head("PUT", path), self.body, self._taken)

    def _taken(self, status: int, _body: bytes) -> None:
        if self._bad(status):
            return
        counts = self.fleet.counts
        counts.windows, counts.bytes = counts.windows + 1, counts.bytes + len(self.body)
        counts.latency.append(time.monotonic() - self.sent)
        self.edge.sequence += 1
        self.done.set()

    def _bad(self, status: int) -> bool:
        """Handle an unexpected status; True: the turn ends, to be repeated or with the whole run."""
        if status in TAKEN:
            return False
        if status in LATER:
            self.fleet.counts.later += 1
            self.fleet.requeue(self.edge, self.due)
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
        turn.begin(*next_one)
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
        late=shares(counts.late),
        waited=counts.waited,
    )


def _window(body: bytes) -> WindowMessage:
    message = decode(body)
    assert isinstance(message, WindowMessage)
    return message


def _servo(edge: LoadEdge) -> str:
    return f"/v1/servos/{edge.name}"


def _head(method: str, path: str) -> bytes:
    return f"{method} {path} HTTP/1.1\r\nHost: twin\r\n".encode()


if __name__ == "__main__":
    given = decode_load(Path(sys.argv[1]).read_bytes())
    sys.stdout.buffer.write(msgspec.json.encode(asyncio.run(run(given))))
