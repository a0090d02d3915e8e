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
from heapq import heappop, heappush
from pathlib import Path
from typing import NamedTuple

import msgspec

from benchmarks.fleet.line import HttpConnection
from benchmarks.fleet.plan import LoadPlan, LoadReport, LoadStart, decode_load, shares
from servotwin.link.http import WAITING
from servotwin.link.seal import Sealed
from servotwin.link.window_order import WindowOrder
from servotwin.messages import Reason, Receipt, Update, WindowMessage, decode, encode

TAKEN, LATER = (200, 201, 202), (429, 503)
PAUSE = 0.2
"""s after which a request that was put off is made again."""
PATIENCE, ANSWER_S = 600.0, 120.0
"""s that windows may wait once no more fall due, and that a turn may take."""

_sealed = msgspec.msgpack.Decoder(list[bytes])


class DueWindow(NamedTuple):
    """A window of an edge that is due: its number, and when it fell due (s)."""

    sequence: int
    due: float


@dataclass
class LoadEdge:
    """One servo.

    Attributes
    ----------
    name : str
    place, tuned : int
        Index of its gap in the stock, and of the gap that the parameters in force are for.
    version, sequence, serial : int
        Of the parameters in force, of the window that falls due next, of the last message that it took.
    receipts : list of Receipt
        Not yet sent.
    waiting : deque of DueWindow
        Not yet taken by the twin, the oldest first, without the one that is on its way.
    order : WindowOrder
        As of an edge's sender.
    newest : int
        Newest window that the twin has taken.
    on_its_way : DueWindow or None
    """

    name: str
    place: int
    tuned: int
    version: int
    sequence: int = 0
    serial: int = 0
    receipts: list[Receipt] = field(default_factory=list)
    waiting: deque[DueWindow] = field(default_factory=deque)
    order: WindowOrder = field(default_factory=WindowOrder)
    newest: int = -1
    on_its_way: DueWindow | None = None
    _fresh: bool = False

    def add(self, due: float) -> DueWindow:
        """Make the next window, due at a time (s)."""
        self.sequence += 1
        return DueWindow(self.sequence - 1, due)

    def next(self, now: float) -> DueWindow | None:
        """Take the window to be sent out of those that wait; None: none may be sent now."""
        if self.on_its_way is not None or not self.waiting:
            return None
        newest = self.waiting[-1] if self.waiting[-1].sequence > self.newest else None
        chosen = self.order.next(now, self.waiting[0], newest, len(self.waiting) - 1)
        if chosen is not None:
            self.waiting.remove(chosen)
        self.on_its_way, self._fresh = chosen, chosen == newest
        return chosen

    def put_back(self) -> None:
        """Put the window on its way back."""
        assert self.on_its_way is not None
        self.waiting, self.on_its_way = deque(sorted([*self.waiting, self.on_its_way])), None

    def taken(self, now: float, pause: float) -> None:
        """Note that the twin has the window on its way, and the pause that it asks for before older ones, s."""
        assert self.on_its_way is not None
        sent, self.on_its_way = self.on_its_way, None
        if self._fresh:
            self.newest = sent.sequence
        self.order.taken(now, self._fresh, len(self.waiting), pause)


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
    latency_after: list[float] = field(default_factory=list)
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
        self._issued, self._cut = 0, False
        self._ready: deque[LoadEdge] = deque()
        self._paused: list[tuple[float, str, LoadEdge]] = []
        self.waiting = 0

    def add_due(self, now: float) -> None:
        """Queue the windows whose time has come."""
        plan, since = self.plan, now - self.begin
        most = min(int(since * plan.rate) + 1, round(plan.duration * plan.rate)) if plan.rate > 0.0 else 0
        while self._issued < most:
            edge = self.edges[self._issued % plan.servos]
            edge.waiting.append(edge.add(self.begin + self._issued / plan.rate))
            self._ready.append(edge)
            self.waiting += 1
            self._issued += 1
        self.counts.waited = max(self.counts.waited, self.waiting)

    def take(self, now: float) -> LoadEdge | None:
        """Take the next edge that has a window to be sent, `on_its_way`; None: not now."""
        plan, since = self.plan, now - self.begin
        if self.cut(now):
            if not self._cut:
                self._cut = True
                for edge in self.edges:
                    edge.order.out_of_reach()
            return None
        if plan.rate > 0.0:
            return self._next(now)
        if since >= plan.duration:
            return None
        self._issued += 1
        edge = self.edges[(self._issued - 1) % plan.servos]
        edge.on_its_way = edge.add(now)
        return edge

    def _next(self, now: float) -> LoadEdge | None:
        """The edge that has been ready for longest, once those are whose pause is over."""
        while self._paused and self._paused[0][0] <= now:
            self._ready.append(heappop(self._paused)[2])
        while self._ready:
            edge = self._ready.popleft()
            if edge.next(now) is not None:
                self.waiting -= 1
                return edge
            if edge.waiting and edge.on_its_way is None:
                heappush(self._paused, (now + edge.order.pause_left(now), edge.name, edge))
        return None

    def cut(self, now: float) -> bool:
        """Test for an outage that has cut every connection."""
        return self.plan.outage[0] <= now - self.begin < self.plan.outage[1]

    def requeue(self, edge: LoadEdge) -> None:
        """Put an edge's postponed window back."""
        edge.put_back()
        self.waiting += 1
        self._ready.appendleft(edge)

    def taken(self, edge: LoadEdge, now: float, pause: float) -> None:
        """Note that the twin has taken an edge's window, and the pause that it asks for before older ones, s."""
        edge.taken(now, pause)
        if edge.waiting:
            self._ready.append(edge)

    def window(self, edge: LoadEdge, sequence: int, due: float) -> bytes:
        """Encoded window of the edge's source, readdressed; sometimes the gap has moved to that of the next source.

        Until the edge applies an update for that gap its windows are of the setting before.
        """
        if self.plan.news > 0.0 and self.chance.random() < self.plan.news:
            edge.place = (edge.place + 1) % len(self.places)
            self.counts.news += 1
        made = self.places[edge.place] if edge.tuned == edge.place else [self.moved[edge.place - 1]]
        template = made[sequence % len(made)]
        start = self.plan.start + (due - self.begin)
        shift = start - template.start
        changes = tuple((time + shift, value) for time, value in template.reference_changes)
        return encode(
            msgspec.structs.replace(
                template,
                servo=edge.name,
                boot=self.plan.boot,
                sequence=sequence,
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
