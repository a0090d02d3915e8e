"""Edges of a bench's fleet, without the connections: windows fall due, and wait in the order of a real edge."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import NamedTuple

import msgspec

from benchmarks.fleet.plan import LoadStart
from servotwin.link.seal import Sealed
from servotwin.link.window_order import WindowOrder
from servotwin.messages import Reason, Receipt, Update, WindowMessage, decode, encode

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


def _window(body: bytes) -> WindowMessage:
    message = decode(body)
    assert isinstance(message, WindowMessage)
    return message
