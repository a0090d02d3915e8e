"""Assembly and main loop of an edge, until its drive's run is over or a signal comes."""

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
from servotwin.edge.recorder import Recorder
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import load
from servotwin.edge_process.control import ControlRole
from servotwin.edge_process.drive import drive_of
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.link_child import LinkChild, link_command
from servotwin.edge_process.monitoring import TroubleLog, log
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.shared_samples import SampleMemory
from servotwin.edge_process.startup import check, exclusive, last_version, next_boot, permitted, stored_parameters
from servotwin.edge_process.supervise import SupervisingRole
from servotwin.errors import InvalidInput
from servotwin.runtime.service_manager import ServiceManager

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_RECONNECT_S, _PAUSE_S, _FINISH_S = 1.0, 0.02, 3.0
_SHARED_S = 20.0
"""s of samples that the live view can look back, also at a simulated machine that runs faster than time."""


class _Role(Protocol):
    """Control or supervise: it handles the samples of a drive, step by step."""

    def step(self) -> bool:
        """Take the next samples; False: the run is over. Raises `DriveLost`."""

    def lost(self) -> None:
        """Note that the drive is lost."""

    def stop(self) -> None:
        """Leave the drive in a safe state. Raises `DriveLost`."""


class StopSignal:
    """Signal handler; `requested` becomes True at a signal.

    The loop tests it between two steps: a drive's `read` resumes after the signal, and returns by its own time limit.
    """

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, number: int, frame: Any) -> None:  # noqa: ARG002
        self.requested = True


def run(path: str | os.PathLike[str]) -> None:
    """Run the edge of an `edge.toml`.

    Raises
    ------
    InvalidInput
        The configuration, the token or the drive is invalid, or another edge runs on the same files.
    """
    config, file = load(path), Path(path).resolve()
    check(config)
    drive = drive_of(config, file)  # before a file is made, for what its table names may be wrong
    with exclusive(config):
        _run(config, file, drive)


def _run(config: EdgeConfig, path: Path, drive: Drive) -> None:
    stored = stored_parameters(config.path(config.files.parameters), last_version(config))
    first = permitted(stored, config.agent, config.units)
    # Before the first sample: counts of samples begin at 0 in each boot, so two starts must not share a name.
    boot = next_boot(config.path(config.files.boots), os.urandom(8))
    outlet = PipeOutlet(config.twin is not None)
    memory = _shared_samples(config)
    child = LinkChild(link_command(path, boot, None if memory is None else memory.descriptor), outlet)
    stop, manager = StopSignal(), ServiceManager()
    before = {each: signal.signal(each, stop) for each in SIGNALS if not _is_ignored(each)}
    try:
        recorder = Recorder if memory is None else memory.recorder
        edge = EdgeRuntime(config, boot, outlet, child, first, time.monotonic, time.sleep, manager, recorder)
        manager.ready()
        until(stop, edge, drive, lambda: _role(edge, drive))
        manager.stopping()
        edge.finish(_FINISH_S)
    finally:
        child.close()
        if memory is not None:
            memory.close()
        drive.close()
        for each, handler in before.items():
            signal.signal(each, handler)
        log("end", windows_left_behind=outlet.untaken)


def _shared_samples(config: EdgeConfig) -> SampleMemory | None:
    """Memory with the samples, where the edge's file allows the live view."""
    if config.twin is None or not config.twin.live:
        return None
    return SampleMemory(round(_SHARED_S * config.agent.sample_rate))


def until(stop: StopSignal, edge: EdgeRuntime, drive: Drive, role_of: Callable[[], _Role]) -> None:
    """Connect, run, and connect again where the drive was lost, until the run is over or a signal comes."""
    role: _Role | None = None
    troubles = TroubleLog()
    configure_garbage_collector()
    set_realtime_priority(edge.config.priority)
    while not stop.requested:
        try:
            _connect(edge.config, drive, known=role is not None)
            troubles.update("drive", "")
            role = role_of() if role is None else role
            run_role(stop, role)
            return
        except DriveLost as error:
            edge.counts["drive lost"] += 1
            troubles.update("drive", str(error))
            _wait(stop, edge)
            if role is not None:
                role.lost()


def run_role(stop: StopSignal, role: _Role) -> None:
    """Step until the run is over or a signal comes; leave the drive in a safe state, also after an error."""
    step = role.step
    try:
        while not stop.requested:
            if not step():
                return
    except DriveLost:
        raise
    except BaseException:
        with suppress(Exception):
            role.stop()
        raise
    role.stop()


def _is_ignored(number: signal.Signals) -> bool:
    """True where the edge shall outlive its terminal (nohup)."""
    return number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def configure_garbage_collector() -> None:
    """Freeze existing objects and collect rarely: the loop makes no cycles, and a collection would delay a sample."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 1000)


def set_realtime_priority(priority: int) -> bool:
    """Run this process, but not its children, under the real-time scheduler; False where that is not possible."""
    if priority == 0:
        return False
    try:
        # RESET_ON_FORK: a link process at real-time priority could delay the tick that it must not delay.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        log("no real-time priority", error=str(error))
        return False
    return True


def _wait(stop: StopSignal, edge: EdgeRuntime) -> None:
    """Wait before the next try to connect to the drive; the link goes on."""
    end = edge.clock() + _RECONNECT_S
    while not stop.requested and edge.clock() < end:
        edge.exchange()
        edge.supervise()
        edge.pause(_PAUSE_S)


def _role(edge: EdgeRuntime, drive: Any) -> _Role:
    return ControlRole(edge, drive) if edge.config.role == "control" else SupervisingRole(edge, drive)


def _connect(config: EdgeConfig, drive: Drive, known: bool) -> None:
    """Connect to the drive; one that was right before and is wrong now counts as lost: it may be starting up."""
    try:
        drive.connect()
        _check_rate(config, drive)
    except InvalidInput as error:
        if not known:
            raise
        # A machine that is restarting may answer with default values for a while.
        raise DriveLost(str(error)) from None


def _check_rate(config: EdgeConfig, drive: Drive) -> None:
    if drive.rate != config.agent.sample_rate:
        mismatch = f"sample_rate_hz = {config.agent.sample_rate!r} Hz: the drive's rate is {drive.rate!r} Hz"
        raise InvalidInput(f"{config.source}: {mismatch}; they must be equal")
