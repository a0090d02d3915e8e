"""Puts an edge together and runs it, until its drive is done or a signal comes."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from servotwin.edge.drive import Drive, DriveLost
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import FileParameterStore
from servotwin.edge.switch import Rules
from servotwin.edge_process.alone import alone
from servotwin.edge_process.boots import next_boot
from servotwin.edge_process.checks import check
from servotwin.edge_process.child import LinkChild, starter
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import load
from servotwin.edge_process.control import Controlling
from servotwin.edge_process.drives import control_drive, supervised_drive
from servotwin.edge_process.edge import Edge
from servotwin.edge_process.log import Troubles, say
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.supervise import Supervising
from servotwin.errors import InvalidInput

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_RECONNECT_S, _PIECE_S, _FINISH_S = 1.0, 0.02, 3.0


class Role(Protocol):
    """What a role does with a drive."""

    def step(self) -> bool:
        """The next samples; whether the run goes on. Raises `DriveLost`."""

    def lost(self) -> None:
        """The drive is away."""

    def stop(self) -> None:
        """Leave the drive in order. Raises `DriveLost`."""


class Stop:
    """Becomes true at a signal.

    Python's `signal` module waits for the end of a system call under way; a drive that is silent returns by itself.
    """

    def __init__(self) -> None:
        self.wanted = False

    def __call__(self, number: int, frame: Any) -> None:  # noqa: ARG002
        self.wanted = True


def run(path: str | os.PathLike[str]) -> None:
    """Run the edge of an `edge.toml`.

    Raises
    ------
    InvalidInput
        The configuration, the token or the drive is not as it must be, or another edge runs on the same files.
    """
    config = load(path)
    check(config)
    with alone(config):
        _run(config, Path(path).resolve())


def _run(config: EdgeConfig, path: Path) -> None:
    drive = control_drive(config) if config.role == "control" else supervised_drive(config)
    first = permitted(first_parameters(config.path(config.keeping.parameters)), config.agent)
    boot = next_boot(config.path(config.keeping.boots), os.urandom(8))
    outlet = PipeOutlet(config.twin is not None)
    child = LinkChild(starter(path), outlet)
    stop = Stop()
    before = {each: signal.signal(each, stop) for each in SIGNALS if not _is_unheard(each)}
    try:
        edge = Edge(config, boot, outlet, child, first, time.monotonic, time.sleep)
        until(stop, edge, drive, lambda: _role(edge, drive))
        edge.finish(_FINISH_S)
    finally:
        child.close()
        drive.close()
        for each, handler in before.items():
            signal.signal(each, handler)
        say("end", windows_left_behind=outlet.untaken)


def first_parameters(path: Path) -> Parameters | None:
    """What an earlier start proved; a file that does not hold it is put aside, since the machine must run."""
    try:
        return FileParameterStore(path).load()
    except InvalidInput as error:
        say("last parameters not readable", error=str(error))
    except OSError as error:
        say("last parameters not readable", error=str(error))
        return None
    try:
        path.replace(path.with_name(f"{path.name}.broken"))
    except OSError as error:
        say("last parameters not put aside", error=str(error))
    return None


def permitted(found: Parameters | None, agent: AgentSettings) -> Parameters | None:
    """What an earlier start proved, where an update to it would be allowed today: the limits may be others by now."""
    if found is None or found.fallback:
        return found
    centre, gains = Rules(agent.limits, agent.controller, agent.own).centre, found.setting.gains
    good = gains is None or (centre is not None and agent.limits.allows_gains(gains, centre))
    if good and agent.limits.allows_tolerance(found.setting.tolerance):
        return found
    say("last parameters not allowed any more", version=found.version, tolerance_m=found.setting.tolerance)
    return None


def until(stop: Stop, edge: Edge, drive: Drive, role_of: Callable[[], Role]) -> None:
    """Connect, run, connect again where the drive was lost."""
    role: Role | None = None
    troubles = Troubles()
    calm()
    hurry(edge.config.priority)
    while not stop.wanted:
        try:
            _connect(edge.config, drive, known=role is not None)
            troubles.look("drive", "")
            role = role_of() if role is None else role
            go_on(stop, role)
            return
        except DriveLost as error:
            edge.counts["drive lost"] += 1
            troubles.look("drive", str(error))
            _wait(stop, edge)
            if role is not None:
                role.lost()


def go_on(stop: Stop, role: Role) -> None:
    """Sample after sample until the run is over or a signal comes; whatever ends it, the drive is left in order."""
    step = role.step
    try:
        while not stop.wanted:
            if not step():
                return
    except DriveLost:
        raise
    except BaseException:
        with suppress(Exception):
            role.stop()
        raise
    role.stop()


def _is_unheard(number: signal.Signals) -> bool:
    """Whether whoever started this wants it to outlive its terminal (nohup)."""
    return number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def calm() -> None:
    """Let the garbage collector leave what is there alone, and look for new cycles rarely: the loop makes none."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 1000)


def hurry(priority: int) -> bool:
    """Ask the scheduler to run this process before others, not those it starts; whether it does."""
    if priority == 0:
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        say("no real-time priority", error=str(error))
        return False
    return True


def _wait(stop: Stop, edge: Edge) -> None:
    """A while without a drive; the link goes on."""
    end = edge.clock() + _RECONNECT_S
    while not stop.wanted and edge.clock() < end:
        edge.exchange()
        edge.tend()
        edge.pause(_PIECE_S)


def _role(edge: Edge, drive: Any) -> Role:
    return Controlling(edge, drive) if edge.config.role == "control" else Supervising(edge, drive)


def _connect(config: EdgeConfig, drive: Drive, known: bool) -> None:
    """Reach the drive; what is wrong with one that was right before may come right again, as when it starts up."""
    try:
        drive.connect()
        _check_rate(config, drive)
    except InvalidInput as error:
        if not known:
            raise
        raise DriveLost(str(error)) from None


def _check_rate(config: EdgeConfig, drive: Drive) -> None:
    if drive.rate != config.agent.sample_rate:
        told = f"sample_rate_hz = {config.agent.sample_rate!r} Hz: the drive's rate is {drive.rate!r} Hz"
        raise InvalidInput(f"{config.source}: {told}; they must be equal")
