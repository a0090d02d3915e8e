"""`servotwin up`: the loop that watches, paces, shows and ends it all."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.live import Live

from servotwin.drives.simulated.diary import read_speed, write_speed
from servotwin.errors import InvalidInput
from servotwin.up import display, pacing, usage
from servotwin.up.display import Picture, clock
from servotwin.up.folder import Folder, opened
from servotwin.up.outages import Outages
from servotwin.up.paced import Mark, Paced
from servotwin.up.plan import SERVOS
from servotwin.up.reading import Reader
from servotwin.up.site import Site, Stopped
from servotwin.up.twin_watch import Twin, TwinWatch

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PIECE_S, SHOW_S, SAY_S, ADAPT_S = 0.1, 0.5, 5.0, 3.0
NEWS_S = 30.0
SPEED, CAUTION = "speed", 0.7


def up(path: Path, speed: float | None = None, seconds: float | None = None, console: Console | None = None) -> None:
    """Run everything until a signal comes, or for a while.

    Parameters
    ----------
    path : Path
        The folder; made if it is missing.
    speed : float, optional
        Machine time per time; None: as fast as the processor's share allows.
    seconds : float, optional
        End after so long; None: when a signal comes.
    console : Console, optional

    Raises
    ------
    InvalidInput
        The folder is another's or in use, a speed or time is not allowed, a process does not start or keeps ending.
    """
    _check("--speed", speed, pacing.FASTEST)
    _check("--for", seconds, 1e9)
    console = console or Console()
    with opened(path) as folder, _stopping() as stop:
        greet(folder, console)
        site = Site(folder, Outages(), stop)
        show = Show(folder, site, speed, console)
        try:
            site.begin()
            show.run(stop, seconds)
        except Stopped:
            console.print("ended before everything ran")
        finally:
            try:
                show.end()
            finally:
                site.end()
        show.conclude()


def greet(folder: Folder, console: Console) -> None:
    """Say where it is and what is gone on with."""
    if folder.new:
        console.print(f"made: {folder.path}: a twin and three servos", soft_wrap=True, highlight=False)
    for servo in SERVOS:
        state = folder.machine(servo)
        if state is not None:
            told = f"{servo.name} at {clock(state.time_s)} of machine time with a gap of {state.gap_deg:.3f} deg"
            console.print(f"going on with {told}", soft_wrap=True, highlight=False)
    console.print("starting (the very first time, code is compiled for a minute or two) ...", highlight=False)


def first_speed(folder: Folder) -> float:
    """A little below the last one, which another machine or another load may not hold."""
    last = [read_speed(folder.servo(servo) / SPEED) or 0.0 for servo in SERVOS]
    return max(pacing.SLOWEST, CAUTION * min(last))


class Stop:
    """Counts signals."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> int:
        return self.count

    def heard(self, _number: int, _frame: FrameType | None) -> None:
        """One more."""
        self.count += 1


class Show:
    """Watches, paces and shows what runs.

    Parameters
    ----------
    folder : Folder
    site : Site
    speed : float, optional
        That stays.
    console : Console
    """

    def __init__(self, folder: Folder, site: Site, speed: float | None, console: Console) -> None:
        self._folder, self._site, self._console = folder, site, console
        self._fixed, self._speed = speed is not None, speed or first_speed(folder)
        self._readers = {servo.name: Reader(servo, folder.servo(servo)) for servo in SERVOS}
        self._watch: TwinWatch | None = None
        self._pace = Paced()
        self._news, self._news_until = "", 0.0
        self._begun = time.monotonic()
        self._ended = 0.0
        self._twin: Twin | None = None
        self._tell_speed()

    def run(self, stop: Stop, seconds: float | None) -> None:
        """Until it is time to end."""
        self._begun = time.monotonic()
        names = [servo.name for servo in SERVOS]
        self._watch = TwinWatch(self._site.url, self._folder.operator(), names)
        self._watch.begin()
        with self._live() as live:
            shown = adapted = self._begun
            while not stop() and not (seconds is not None and time.monotonic() - self._begun >= seconds):
                time.sleep(PIECE_S)
                now = time.monotonic()
                self._tend(now)
                if now >= adapted + ADAPT_S:
                    adapted = now
                    self._adapt(now)
                if now >= shown + (SAY_S if live is None else SHOW_S):
                    shown = now
                    self._show(live, now)

    def end(self) -> None:
        """Ask the twin no more, after a last look."""
        if self._watch is not None:
            self._ended = time.monotonic()
            self._twin = self._watch.twin
            self._watch.end()
            self._console.print("ending: edges, machines, twin ...", highlight=False)

    def conclude(self) -> None:
        """The last words, when all have written theirs."""
        if self._watch is None:
            return
        picture = self._picture(self._ended, self._twin)
        for line in display.summary(picture):
            self._console.print(line, soft_wrap=True, highlight=False)
        pace = self._pace
        told = f"{pace.mean_speed:.1f} times real time, {pace.told_share}, for {clock(picture.seconds)}"
        self._console.print(
            f"in the mean {told}; all has ended, and goes on from here", soft_wrap=True, highlight=False
        )

    @contextmanager
    def _live(self) -> Iterator[Live | None]:
        if not self._console.is_terminal:
            yield None
            return
        with Live(console=self._console, auto_refresh=False) as live:
            yield live

    def _show(self, live: Live | None, now: float) -> None:
        picture = self._picture(now, None if self._watch is None else self._watch.twin)
        if live is None:
            self._console.print(display.line(picture), soft_wrap=True, highlight=False, markup=False)
        else:
            live.update(display.rendered(picture), refresh=True)

    def _tend(self, now: float) -> None:
        for news in self._site.tend(now):
            self._news, self._news_until = news, now + NEWS_S
            if not self._console.is_terminal:
                self._console.print(news, soft_wrap=True, highlight=False, markup=False)

    def _adapt(self, now: float) -> None:
        states = {servo.name: self._readers[servo.name].machine() for servo in SERVOS}
        marks = {name: Mark(state.time_s, state.written) for name, state in states.items() if state is not None}
        self._pace.look(usage.times(self._site.groups, {os.getpid()}), marks, now)
        twin = None if self._watch is None else self._watch.twin
        waiting = 0 if twin is None else twin.waiting
        if not self._fixed and self._pace.settled:
            self._speed = pacing.next_speed(self._speed, self._pace.seen(waiting))
            self._tell_speed()

    def _tell_speed(self) -> None:
        with suppress(OSError):
            for servo in SERVOS:
                write_speed(self._folder.servo(servo) / SPEED, self._speed)

    def _picture(self, now: float, twin: Twin | None) -> Picture:
        left = 0.0 if self._site.forwarder is None else self._site.forwarder.left
        views = []
        for servo in SERVOS:
            told = None if self._watch is None else self._watch.estimates.get(servo.name)
            restarts = self._site.machines[servo.name].restarts + self._site.edges[servo.name].restarts
            views.append(self._readers[servo.name].view(told, left if servo.outages else 0.0, restarts))
        pace, news = self._pace, self._news if now < self._news_until else ""
        where = self._site.url, str(self._folder.path), news
        return Picture(tuple(views), twin, now - self._begun, self._speed, pace.reached, pace.cores, pace.share, *where)


@contextmanager
def _stopping() -> Iterator[Stop]:
    """Signals counted, not obeyed; a terminal's Ctrl-C comes here only, as children are in sessions of their own."""
    stop = Stop()
    before = [signal.signal(number, stop.heard) for number in SIGNALS]
    try:
        yield stop
    finally:
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)


def _check(option: str, value: float | None, most: float) -> None:
    if value is not None and not 0.0 < value <= most:
        raise InvalidInput(f"{option} {value:g}: must be greater than 0 and at most {most:g}")
