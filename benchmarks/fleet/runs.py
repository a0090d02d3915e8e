"""The two runs: as many windows as the twin takes, and a fleet at its cadence with an outage."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from benchmarks.fleet import findings
from benchmarks.fleet.findings import BacklogWork, ProcessedWork
from benchmarks.fleet.plan import LoadPlace, LoadPlan, LoadReport, LoadStart, encode_load
from benchmarks.fleet.processes import service
from benchmarks.fleet.setting import STORE, FleetScale, commission, write_file
from benchmarks.fleet.stock import BOOT, COMMISSIONED, WindowSource
from benchmarks.fleet.watch import ResourceSample, ResourceWatch
from servotwin.messages import encode
from servotwin.store.store import open_store

LOOK_S = 1.0
LONGEST_DRAIN = 1800.0  # s that the twin may take for the windows that wait at the end
_RAMP = 0.1  # share of the steady time that is left out: caches fill, code is compiled


class FleetRun(NamedTuple):
    """Measurements of a run.

    Attributes
    ----------
    report : LoadReport
        Report of the edges.
    watch : ResourceWatch
    steady : ProcessedWork
        Work on the windows that came in undisturbed time.
    made : dict of str to int
        Evidence by kind.
    behind : float
        Windows that waited when the link came back, at the edges and at the twin.
    drained : float
        s from then until no more than a second's windows waited; NaN: never.
    fresh : tuple of float
        s from when the link came back until the first window of a servo was processed that was cut in the last period
        before that or later, rising: of each servo with such a window.
    backlog : BacklogWork
    judged : tuple of float
        As `fresh`, but until such a window was estimated, or nothing had moved in it.
    """

    report: LoadReport
    watch: ResourceWatch
    steady: ProcessedWork
    made: dict[str, int]
    behind: float
    drained: float
    fresh: tuple[float, ...] = ()
    backlog: BacklogWork = BacklogWork()
    judged: tuple[float, ...] = ()


def ingest(
    folder: Path, scale: FleetScale, places: Sequence[WindowSource], tell: Callable[[ResourceSample], None]
) -> FleetRun:
    """Send windows as fast as the twin takes them; it estimates nothing."""
    write_file(folder, scale, enabled=False)
    open_store(f"sqlite:///{folder / STORE}").close()
    plan = LoadPlan(0, scale.servos, BOOT, scale.connections, scale.ingest, start=COMMISSIONED)
    return _run(folder, plan, _load(places, [0] * len(places)), tell)


def fleet(
    folder: Path, scale: FleetScale, places: Sequence[WindowSource], tell: Callable[[ResourceSample], None]
) -> FleetRun:
    """Run a fleet: steady time, an outage, and time after it."""
    registry = write_file(folder, scale)
    known = commission(folder, registry, scale, places)
    begin = scale.steady
    plan = LoadPlan(
        0,
        scale.servos,
        BOOT,
        scale.connections,
        scale.steady + scale.outage + scale.after,
        scale.rate,
        scale.news,
        polls=True,
        start=COMMISSIONED,
        outage=(begin, begin + scale.outage),
    )
    return _run(folder, plan, _load(places, [one.version for one in known]), tell)


def _load(places: Sequence[WindowSource], versions: Sequence[int]) -> tuple[LoadPlace, ...]:
    """Windows for the process of the edges, and the versions of parameters in force there."""
    return tuple(
        LoadPlace(place.gap, version, tuple(map(encode, place.windows)), encode(place.moved))
        for place, version in zip(places, versions, strict=True)
    )


def _run(
    folder: Path, plan: LoadPlan, places: tuple[LoadPlace, ...], tell: Callable[[ResourceSample], None]
) -> FleetRun:
    with service(folder) as twin, findings.reading(folder / STORE) as store:
        plan = msgspec.structs.replace(plan, port=twin.port)
        before, since = findings.stored(store), time.time()
        with _edges(folder, plan, places) as edges:
            watch = ResourceWatch(twin.process.pid, edges.pid, lambda: findings.waiting(store, time.time()))
            behind = _watched(edges, watch, plan, tell, lambda: findings.stored(store) - before)
            report = _reported(edges)
        steady = plan.outage[0] or plan.duration
        work = findings.done(store, since + _RAMP * steady, since + steady)
        broken = findings.failures(store)
        if broken or twin.process.poll() is not None:
            raise RuntimeError(f"the twin failed: {'; '.join(broken) or 'its process ended'}")
        fresh, judged, backlog, (begin, end) = tuple[float, ...](), tuple[float, ...](), BacklogWork(), plan.outage
        if end > 0.0:
            # The edges begin when they are connected: by a fraction of a second later than `since`.
            newest = plan.start + end - plan.servos / plan.rate
            fresh, judged = (tuple(findings.fresh(store, newest, since + end, own)) for own in (False, True))
            backlog = findings.worked_off(store, plan.start + begin, plan.start + end, since + end)
        return FleetRun(report, watch, work, findings.made(store, since), *behind, fresh, backlog, judged)


def _watched(
    edges: subprocess.Popen[bytes],
    watch: ResourceWatch,
    plan: LoadPlan,
    tell: Callable[[ResourceSample], None],
    stored: Callable[[], int],
) -> tuple[float, float]:
    """Wait until the edges are done and nothing waits; (windows behind when the link came back, s until drained)."""
    behind, drained, back = 0.0, float("nan"), plan.outage[1]
    quiet = max(plan.rate * LOOK_S, 1.0)
    while True:
        sample = watch.look()
        tell(sample)
        due = plan.rate * min(sample.time, plan.duration)
        backlog = max(0.0, due - stored()) + sample.waiting
        if back > 0.0 and sample.time < back + LOOK_S:
            behind = backlog
        elif back > 0.0 and drained != drained and backlog <= quiet:
            drained = sample.time - back
        running = edges.poll() is None
        if not running and (sample.waiting == 0 or plan.rate == 0.0 or sample.time > plan.duration + LONGEST_DRAIN):
            return behind, drained
        time.sleep(LOOK_S)


@contextmanager
def _edges(folder: Path, plan: LoadPlan, places: tuple[LoadPlace, ...]) -> Iterator[subprocess.Popen[bytes]]:
    """Run the edges' process."""
    load = LoadStart(plan, places)
    path = folder / "edges.load"
    path.write_bytes(encode_load(load))
    command = [sys.executable, "-m", "benchmarks.fleet.edges", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=dict(os.environ)) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def _reported(edges: subprocess.Popen[bytes]) -> LoadReport:
    output, complaint = edges.communicate()
    if edges.returncode != 0:
        raise RuntimeError(f"the edges failed: {complaint.decode(errors='replace').strip().splitlines()[-1:]}")
    return msgspec.json.decode(output, type=LoadReport)
