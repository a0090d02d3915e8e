"""The edge's real control loop against a drive that keeps to the clock, in a process of its own; prints JSON.

`python -m benchmarks.tickloop RATE SECONDS MOVING PRIORITY FOLDER [LIVE]`: numpy is not imported, as on a real edge.
LIVE is "allowed" where the samples lie in shared memory, and "watched" where a process reads them for a live view.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import sin
from pathlib import Path
from typing import Any

from servotwin.control.controller import Controller
from servotwin.edge.drive import DriveSample
from servotwin.edge.outlet import CHANNELS, pack
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.recorder import Cut, Recorder, as_floats
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.edge_process.config_file import edge_toml
from servotwin.edge_process.control import ControlRole
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.link_child import LinkChild, link_command
from servotwin.edge_process.monitoring import TickHistogram, summarise
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.run import configure_garbage_collector, set_realtime_priority
from servotwin.edge_process.shared_samples import MakeRecorder, SampleMemory
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import Band, Setting
from servotwin.runtime.service_manager import ServiceManager

STEP_S = 2.0
_REPEATS = 20


class PacedDrive:
    """Samples at fixed instants; an instant that is missed by a whole period is a sample missed, as at a machine.

    Parameters
    ----------
    rate : float
        Hz.
    seconds : float
    moving : bool
        True: the reference always moves, so that windows are cut one after the other. False: it steps now and then.
    """

    machine, lag = "paced", 0.0

    def __init__(self, rate: float, seconds: float, moving: bool) -> None:
        self.rate = rate
        self.wake, self.answer, self.whole = TickHistogram(), TickHistogram(), TickHistogram()
        self.overruns = self.missed = 0
        self._end, self._moving = round(rate * seconds), moving
        self._number, self._position, self._zero, self._woken = 0, 0.0, 0.0, 0.0

    def connect(self) -> None:
        """Start the clock."""
        self._zero = time.perf_counter()

    def close(self) -> None:
        """Release nothing."""

    def read(self) -> DriveSample | None:
        """Wait for the next instant."""
        now = time.perf_counter()
        if self._number > 0:
            self.whole.add(now - self._woken)
            self.overruns += now - self._woken > 1.0 / self.rate
        due = self._zero + self._number / self.rate
        if due > now:
            time.sleep(due - now)
        self._woken = time.perf_counter()
        self.wake.add(self._woken - due)
        late = int((self._woken - due) * self.rate)
        self.missed += late
        number = self._number + late
        self._number = number + 1
        return (
            None
            if number >= self._end
            else DriveSample(number, self._reference(number), self._position, self._position)
        )

    def write(self, voltage: float) -> None:
        """Move the simulated machine with its voltage."""
        self.answer.add(time.perf_counter() - self._woken)
        self._position += 1e-6 * voltage

    def _reference(self, number: int) -> float:
        time_s = number / self.rate
        return 1e-3 * sin(time_s) if self._moving else 1e-3 * (int(time_s / STEP_S) % 2)


def config(rate: float, folder: Path) -> EdgeConfig:
    """An edge that watches its loop, as a certified one does, and has no twin."""
    law = Controller(500.0, 0.0, -50.0, 0.1, voltage_limit=10.0, sample_rate=rate)
    watched = Supervision(FallbackSet(Setting(1e-4, band=Band(1.0, 1.0, 100.0, 3.0))), WatchSettings())
    agent = AgentSettings("axis-1", UNBOOTED, rate, supervision=watched, fine_angle=True)
    return EdgeConfig(agent, "control", law, {"kind": "simulated"}, folder=folder)


@contextmanager
def live_recorder(rate: float, live: str) -> Iterator[MakeRecorder]:
    """Ring buffers as an edge's file allows them; watched: read as a link process does, by a process of its own."""
    if not live:
        yield Recorder
        return
    memory = SampleMemory(round(3.0 * rate))
    command = [sys.executable, "-m", "benchmarks.live_reader", str(memory.descriptor), str(rate)]
    reader = subprocess.Popen(command, pass_fds=(memory.descriptor,)) if live == "watched" else None
    try:
        yield memory.recorder
    finally:
        if reader is not None:
            reader.kill()
            reader.wait()
        memory.close()


def measured(
    rate: float, seconds: float, moving: bool, priority: int, folder: Path, recorder: MakeRecorder = Recorder
) -> dict[str, Any]:
    """Measure one run."""
    settings = config(rate, folder)
    file = folder / "edge.toml"
    file.write_text(edge_toml(settings), encoding="utf-8")
    drive, outlet = PacedDrive(rate, seconds, moving), PipeOutlet(False)
    child = LinkChild(link_command(file, "bench"), outlet)
    edge = EdgeRuntime(
        settings, "bench", outlet, child, None, time.perf_counter, time.sleep, ServiceManager({}), recorder
    )
    role = ControlRole(edge, drive)
    child.check(edge.clock())
    time.sleep(1.0)  # until it listens: its start is not what is measured
    configure_garbage_collector()
    hurried = set_realtime_priority(priority)
    drive.connect()
    while role.step():
        pass
    edge.finish(10.0)
    child.close()
    windows = edge.agent.windows_cut
    conditions = {"rate_hz": rate, "moving": moving, "realtime": hurried, "windows": windows}
    return {**conditions, **_result(drive, edge), "load": os.getloadavg()[0]}


def _result(drive: PacedDrive, edge: EdgeRuntime) -> dict[str, Any]:
    times = {"wake": drive.wake, "answer": drive.answer, "whole": drive.whole}
    summaries = {name: summarise(counts.dumps(), counts.longest) for name, counts in times.items()}
    return {**summaries, "overruns": drive.overruns, "missed": drive.missed, "dropped": dict(edge.agent.dropped)}


def handling(rate: float, folder: Path) -> dict[str, float]:
    """Median times (s) of packing and storing a window of 1 s in the link process."""
    settings = config(rate, folder)
    samples = round(rate)
    values = {
        name: as_floats([1e-3 * sin(k * (3 + m) * 1e-3) for k in range(samples)]) for m, name in enumerate(CHANNELS)
    }
    box = SqliteOutbox(folder / "put.sqlite", "axis-1")
    packs, puts = [], []
    for k in range(_REPEATS):
        begin = time.perf_counter()
        window = pack(Cut(0, k, "reference", 0, 0.0, values), replace(settings.agent, boot="bench"))
        middle = time.perf_counter()
        box.put(window)
        packs.append(middle - begin)
        puts.append(time.perf_counter() - middle)
    box.close()
    return {"pack_s": sorted(packs)[_REPEATS // 2], "put_s": sorted(puts)[_REPEATS // 2]}


def main(arguments: list[str]) -> None:
    """Measure, print."""
    rate, seconds, moving, priority = float(arguments[0]), float(arguments[1]), arguments[2] == "1", int(arguments[3])
    folder = Path(arguments[4])
    with live_recorder(rate, arguments[5] if len(arguments) > 5 else "") as recorder:
        run = measured(rate, seconds, moving, priority, folder, recorder)
    print(json.dumps({**run, **handling(rate, folder)}))


if __name__ == "__main__":
    main(sys.argv[1:])
