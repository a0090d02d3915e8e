"""A simulated link in virtual time, with delay, jitter, loss, duplicates, reordering, outages and a record.

Events of the virtual clock are ordered by (time, priority, serial), so equal times resolve the same way in every run.
"""

import heapq
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from hashlib import blake2b
from math import inf
from random import Random
from typing import Annotated, NamedTuple

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.link.session import Item, Session
from servotwin.messages import encode


def outage_table(
    begin: Annotated[float, key("from_s", help="Begin of the outage.")],
    end: Annotated[float, key("to_s", help="End of the outage.")],
) -> tuple[float, float]:
    """One outage of a link."""
    return begin, end


@settings("link")
@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Delays and losses of a link, the same in both directions."""

    delay_s: Annotated[float, key(minimum=0.0, help="Time that every message takes.")] = 0.0
    jitter_s: Annotated[float, key(minimum=0.0, help="A message takes up to this much longer, evenly distributed.")] = (
        0.0
    )
    loss: Annotated[float, key(minimum=0.0, maximum=1.0, help="Probability that a message is lost.")] = 0.0
    duplicate: Annotated[float, key(minimum=0.0, maximum=1.0, help="Probability that it arrives twice.")] = 0.0
    reorder: Annotated[
        float,
        key(minimum=0.0, maximum=1.0, help="Probability that it is held back, so that later ones overtake it."),
    ] = 0.0
    hold_s: Annotated[float, key(minimum=0.0, help="Longest time for which it is held back.")] = 1.0
    outages: Annotated[
        tuple[tuple[float, float], ...],
        key(
            makers={"": outage_table},
            dump=lambda outage: {"from_s": outage[0], "to_s": outage[1]},
            help="Times of outages: what is sent or would arrive in between is lost.",
        ),
    ] = ()

    def __post_init__(self) -> None:
        check(self)
        for begin, end in self.outages:
            if not begin < end < inf:
                raise InvalidInput(f"link outage from {begin!r} s to {end!r} s: must end after it begins")

    def out(self, time: float) -> bool:
        """True where the link is cut at that time (s)."""
        return any(begin <= time < end for begin, end in self.outages)


class Fate(StrEnum):
    """Fate of a copy of a message."""

    IN_FLIGHT = "in flight"
    DELIVERED = "delivered"
    LOST = "lost"
    OUTAGE = "lost in an outage"


@dataclass(slots=True)
class SentCopy:
    """One copy of one message, with its times and its fate.

    Attributes
    ----------
    serial, copy : int
        Number of the message in its direction; 0, or 1 for a duplicate.
    data : bytes
    sent, arrival : float
        Times, s; a lost copy has the arrival that it would have had.
    fate : Fate
    """

    serial: int
    copy: int
    data: bytes
    sent: float
    arrival: float
    fate: Fate = Fate.IN_FLIGHT


Action = Callable[[], object]


class Event(NamedTuple):
    """Action and its time (s); at equal times the lower priority goes first, then the event scheduled first."""

    time: float
    priority: int
    serial: int
    action: Action


class VirtualClock:
    """A clock that jumps from event to event.

    Parameters
    ----------
    now : float
        Time at the start, s.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now
        self._serial = 0
        self._queue: list[Event] = []

    @property
    def now(self) -> float:
        """Present time, s."""
        return self._now

    @property
    def next_time(self) -> float | None:
        """Time at which the next event is due, s; None: nothing is scheduled."""
        return self._queue[0].time if self._queue else None

    def schedule(self, time: float, action: Action, priority: int = 0) -> Event:
        """Call `action` at `time`; the returned event can be cancelled.

        Raises
        ------
        ValueError
            When the time has passed or is not a number.
        """
        if not time >= self._now:
            raise ValueError(f"cannot schedule at {time} s: it is {self._now} s")
        event = Event(time, priority, self._serial, action)
        self._serial += 1
        heapq.heappush(self._queue, event)
        return event

    def cancel(self, event: Event) -> bool:
        """Remove an event from the queue; False when it has happened already."""
        if event not in self._queue:
            return False
        self._queue.remove(event)
        heapq.heapify(self._queue)
        return True

    def step(self) -> None:
        """Advance to the next event and perform it."""
        event = heapq.heappop(self._queue)
        self._now = event.time
        event.action()

    def run_until(self, time: float) -> None:
        """Perform all events up to and including `time`, and advance to it."""
        while self._queue and self._queue[0].time <= time:
            self.step()
        self._now = max(self._now, time)


class LinkDirection:
    """One direction of a link.

    Parameters
    ----------
    name : str
        Name of its random source, together with `seed`.
    clock : VirtualClock
    deliver : callable
        Called with the bytes when they arrive.
    settings : LinkSettings
    seed : int
    """

    def __init__(
        self, name: str, clock: VirtualClock, deliver: Callable[[bytes], object], settings: LinkSettings, seed: int
    ) -> None:
        self.name, self.settings = name, settings
        self.offered = 0
        self.records: list[SentCopy] = []
        self._clock, self._deliver = clock, deliver
        self._random = Random(derive_seed(seed, name))

    def send(self, data: bytes) -> None:
        """Send a message at the clock's time."""
        serial, self.offered = self.offered, self.offered + 1
        # The delay of the duplicate is drawn even where none is sent, as in `_delay`.
        first, second, lost, twice = self._delay(), self._delay(), self._chance("loss"), self._chance("duplicate")
        self._launch(SentCopy(serial, 0, data, self._clock.now, self._clock.now + first), lost)
        if twice and not lost:
            self._launch(SentCopy(serial, 1, data, self._clock.now, self._clock.now + second), lost=False)

    def tally(self) -> Counter[Fate]:
        """Count the copies by fate."""
        return Counter(record.fate for record in self.records)

    def _launch(self, record: SentCopy, lost: bool) -> None:
        self.records.append(record)
        if lost:
            record.fate = Fate.LOST
        elif self.settings.out(record.sent):
            record.fate = Fate.OUTAGE
        else:
            self._clock.schedule(record.arrival, partial(self._arrive, record))

    def _arrive(self, record: SentCopy) -> None:
        if self.settings.out(record.arrival):
            record.fate = Fate.OUTAGE
            return
        record.fate = Fate.DELIVERED
        self._deliver(record.data)

    def _delay(self) -> float:
        # All three are drawn whatever the settings are: a change of one leaves the other draws as they are.
        jitter, hold, is_held = self._random.random(), self._random.random(), self._chance("reorder")
        return self.settings.delay_s + jitter * self.settings.jitter_s + is_held * hold * self.settings.hold_s

    def _chance(self, key: str) -> bool:
        return self._random.random() < float(getattr(self.settings, key))


class SimulatedLink:
    """Both directions between one servo's edge and its twin.

    Parameters
    ----------
    servo : str
    clock : VirtualClock
    to_twin, to_edge : callable
        Called with the bytes that arrive there.
    up, down : LinkSettings
        Of the direction to the twin, and of the one to the edge.
    seed : int
    """

    def __init__(
        self,
        servo: str,
        clock: VirtualClock,
        to_twin: Callable[[bytes], object],
        to_edge: Callable[[bytes], object],
        up: LinkSettings,
        down: LinkSettings,
        seed: int,
    ) -> None:
        self.up = LinkDirection(f"{servo}/up", clock, to_twin, up, seed)
        self.down = LinkDirection(f"{servo}/down", clock, to_edge, down, seed)


class SimulatedSender:
    """Sends what is due in a session over one direction of a simulated link, again until it is acknowledged.

    Parameters
    ----------
    session : Session
    clock : VirtualClock
    line : LinkDirection
        To the twin.
    """

    def __init__(self, session: Session, clock: VirtualClock, line: LinkDirection) -> None:
        self._session, self._clock, self._line = session, clock, line
        self._wake: Event | None = None

    def send_due(self) -> None:
        """Send everything that is due at the clock's time."""
        now = self._clock.now
        for item in list(self._session.due(now)):
            self._line.send(self._body(item))
            self._session.retry_later(item, now)
        self.plan(now)

    def plan(self, earliest: float) -> None:
        """Plan the next `send_due`, no earlier than a time (s); call it after each change of the outbox."""
        if self._wake is not None:
            self._clock.cancel(self._wake)
        due = self._session.next_time
        self._wake = None if due is None else self._clock.schedule(max(due, earliest, self._clock.now), self.send_due)

    def acknowledge(self, item: Item) -> None:
        """Remove a message that the twin has acknowledged."""
        self._session.acknowledge(item)
        self.plan(self._clock.now)

    def _body(self, item: Item) -> bytes:
        outbox = self._session.outbox
        return outbox.letter(item).body if isinstance(item, bytes) else encode(outbox.get(item))


def derive_seed(root: int, *names: str) -> int:
    """Derive the 64-bit seed of a named random source, the same on every machine and in every run."""
    # Not `hash`, which differs from process to process.
    text = "\0".join((str(root), *names))
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")
