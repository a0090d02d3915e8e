"""`servotwin up`: the loop that watches the processes, adapts the speed, shows the status and ends it all."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.live import Live

from servotwin.drives.simulated.machine_state import read_speed, write_speed
from servotwin.errors import InvalidInput
from servotwin.up import display
from servotwin.up.display import Snapshot, clock
from servotwin.up.folder import Folder, opened
from servotwin.up.outages import Outages
from servotwin.up.plan import Plan
from servotwin.up.scenario_plan import ScenarioPlan
from servotwin.up.site import Site, StartInterrupted
from servotwin.up.speed import CORES, FASTEST, SLOWEST, MachineTime, SpeedMeter, next_speed, processor_times
from servotwin.up.status import ServoReader, TwinPoller, TwinStatus

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_TICK_S, _TABLE_S, _LINE_S, _ADAPT_S, _EVENT_S = 0.1, 0.5, 5.0, 3.0, 30.0
"""s between checks of signals and processes, tables, plain lines and speeds; s for which an event is shown."""
_SPEED_FILE = "speed"
_CAUTION = 0.7
"""Share of the last speed at which a start begins."""


def up(
    path: Path,
    scenarios: Sequence[Path] = (),
    machines: int = 1,
    speed: float | None = None,
    seconds: float | None = None,
    console: Console | None = None,
) -> None:
    """Run twin, edges and machines until a signal comes, or for a while.

    Parameters
    ----------
    path : Path
        The folder; made if it is missing.
    scenarios : sequence of Path
        Files of the scenarios whose machines run; none: those of the folder, in a new one the demonstration.
    machines : int
        Machines of each scenario.
    speed : float, optional
        Machine time per time; None: real time for scenarios, and the demonstration as fast as the processor's share
        allows.
    seconds : float, optional
        Time after which it ends, s; None: when a signal comes.
    console : Console, optional

    Raises
    ------
    InvalidInput
        A scenario is not allowed, the folder holds something else or is in use, a speed or time is not allowed, a
        process does not start or keeps ending.
    """
    _check_positive("--speed", speed, FASTEST)
    _check_positive("--for", seconds, 1e9)
    console = console or Console()
    if machines != 1 and not scenarios:
        raise InvalidInput(f"--machines {machines}: is the number of machines of each scenario; name a scenario's file")
    plan = ScenarioPlan.read(scenarios, machines) if scenarios else None
    with opened(path, plan, partial(_announce_making, console)) as folder, _counted_signals() as signals:
        _greet(folder, console)
        site = Site(folder, Outages(), signals, lambda url: _announce(folder, url, console))
        monitor = _Monitor(folder, site, speed, console)
        try:
            site.start()
            monitor.run(signals, seconds)
        except StartInterrupted:
            console.print("ended by a signal before everything ran")
        finally:
            try:
                monitor.stop()
            finally:
                site.stop()
        monitor.print_summary()


def _announce_making(console: Console, path: Path, plan: Plan) -> None:
    names = ", ".join(servo.name for servo in plan.servos)
    line = f"making {path}: a twin for {names} (the very first time, code is compiled for minutes) ..."
    console.print(line, soft_wrap=True, highlight=False, markup=False)


def _greet(folder: Folder, console: Console) -> None:
    for servo in folder.servos:
        state = folder.machine(servo)
        if state is not None:
            described = f"{servo.name} at {clock(state.time_s)} of machine time with a gap of {state.gap_deg:.3f} deg"
            console.print(f"continuing with {described}", soft_wrap=True, highlight=False)
    console.print("starting (the very first time, code is compiled for minutes) ...", highlight=False)


def _announce(folder: Folder, url: str, console: Console) -> None:
    """Print the address of the dashboard, and where the token is that it asks for once."""
    for line in (f"twin: listening on {url}", f"dashboard: open {url} and give it the token in {folder.operator_file}"):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def _initial_speed(folder: Folder) -> float:
    """Choose a speed a little below the last one, which this machine may not reach under its present load."""
    try:
        last = [read_speed(folder.servo(servo) / _SPEED_FILE) or 0.0 for servo in folder.servos]
    except InvalidInput:  # it is written anew before the machines start
        return SLOWEST
    return max(SLOWEST, _CAUTION * min(last))


class _SignalCounter:
    """Counts signals; called, it returns their number."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self) -> int:
        return self._count

    def handle(self, _number: int, _frame: FrameType | None) -> None:
        """Handle a signal."""
        self._count += 1


class _Monitor:
    """Watches what runs, adapts its speed and shows its status.

    Parameters
    ----------
    folder : Folder
    site : Site
    speed : float, optional
        Fixed speed; None: adapted.
    console : Console
    """

    def __init__(self, folder: Folder, site: Site, speed: float | None, console: Console) -> None:
        self._folder, self._site, self._console = folder, site, console
        fixed = folder.speed if speed is None else speed
        self._fixed, self._speed = fixed is not None, fixed or _initial_speed(folder)
        self._readers = {servo.name: ServoReader(servo, folder.servo(servo)) for servo in folder.servos}
        self._poller: TwinPoller | None = None
        self._meter = SpeedMeter()
        self._event, self._event_until = "", 0.0
        self._begun = time.monotonic()
        self._ended = 0.0
        self._last_twin: TwinStatus | None = None
        self._write_speed()

    def run(self, signals: _SignalCounter, seconds: float | None) -> None:
        """Run until a signal comes or `seconds` have passed."""
        self._begun = time.monotonic()
        names = [servo.name for servo in self._folder.servos]
        self._poller = TwinPoller(self._site.url, self._folder.operator(), names)
        self._poller.start()
        with self._live() as live:
            if live is None:
                # No table on a pipe or in a file: a line every 5 s.
                self._print(f"logs: {self._folder.path}/*.log")
            shown = adapted = self._begun
            while not signals() and not (seconds is not None and time.monotonic() - self._begun >= seconds):
                time.sleep(_TICK_S)
                now = time.monotonic()
                self._restart_ended(now)
                if now >= adapted + _ADAPT_S:
                    adapted = now
                    self._adapt(now)
                if now >= shown + (_LINE_S if live is None else _TABLE_S):
                    shown = now
                    self._show(live, now)

    def stop(self) -> None:
        """Stop polling the twin; keep its last status."""
        if self._poller is not None:
            self._ended = time.monotonic()
            self._last_twin = self._poller.twin
            self._poller.stop()
            self._console.print("ending: edges, machines, twin ...", highlight=False)

    def print_summary(self) -> None:
        """Print the final status, once all processes have written theirs."""
        if self._poller is None:
            return
        snapshot = self._snapshot(self._ended, self._last_twin)
        for line in display.summary(snapshot):
            self._print(line)
        share = self._meter.mean_share
        use = "an unknown share of the processor" if share is None else f"{100 * share:.0f} % of {CORES} cores"
        mean = f"{self._meter.mean_speed:.1f} times real time, {use}, for {clock(snapshot.seconds)}"
        self._print(f"mean: {mean}; all processes have ended, and the next start continues from here")

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, highlight=False, markup=False)

    @contextmanager
    def _live(self) -> Iterator[Live | None]:
        if not self._console.is_terminal:
            yield None
            return
        with Live(console=self._console, auto_refresh=False) as live:
            yield live

    def _show(self, live: Live | None, now: float) -> None:
        snapshot = self._snapshot(now, None if self._poller is None else self._poller.twin)
        if live is None:
            self._print(display.line(snapshot))
        else:
            live.update(display.table(snapshot), refresh=True)

    def _restart_ended(self, now: float) -> None:
        for event in self._site.restart_ended(now):
            self._event, self._event_until = event, now + _EVENT_S
            if not self._console.is_terminal:
                self._print(event)

    def _adapt(self, now: float) -> None:
        states = {servo.name: self._readers[servo.name].machine() for servo in self._folder.servos}
        times = {name: MachineTime(state.time_s, state.written) for name, state in states.items() if state is not None}
        self._meter.measure(processor_times(self._site.groups, {os.getpid()}), times, now)
        twin = None if self._poller is None else self._poller.twin
        waiting = 0 if twin is None else twin.waiting
        if not self._fixed and self._meter.started:
            self._speed = next_speed(self._speed, self._meter.sample(waiting))
            self._write_speed()

    def _write_speed(self) -> None:
        with suppress(OSError):
            for servo in self._folder.servos:
                write_speed(self._folder.servo(servo) / _SPEED_FILE, self._speed)

    def _snapshot(self, now: float, twin: TwinStatus | None) -> Snapshot:
        left = 0.0 if self._site.forwarder is None else self._site.forwarder.left
        servos = []
        for servo in self._folder.servos:
            estimate = None if self._poller is None else self._poller.estimates.get(servo.name)
            restarts = self._site.machines[servo.name].restarts + self._site.edges[servo.name].restarts
            servos.append(self._readers[servo.name].read(estimate, left if servo.outages else 0.0, restarts))
        return Snapshot(
            servos=tuple(servos),
            twin=twin,
            seconds=now - self._begun,
            speed=self._speed,
            reached=self._meter.reached,
            cores=self._meter.cores,
            share=self._meter.share,
            url=self._site.url,
            folder=str(self._folder.path),
            event=self._event if now < self._event_until else "",
        )


@contextmanager
def _counted_signals() -> Iterator[_SignalCounter]:
    """Count signals instead of ending; Ctrl-C comes only here, as children are in sessions of their own."""
    counter = _SignalCounter()
    # SIGHUP as well: it comes when the terminal is closed.
    before = [signal.signal(number, counter.handle) for number in _SIGNALS]
    try:
        yield counter
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


def _check_positive(option: str, value: float | None, maximum: float) -> None:
    if value is not None and not 0.0 < value <= maximum:
        raise InvalidInput(f"{option} {value:g}: must be greater than 0 and at most {maximum:g}")
