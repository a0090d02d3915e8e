"""Cost of the dashboard to the twin, to acknowledgements and the browser: `python -m benchmarks.dashboard [SECONDS]`.

A twin with a thousand machines gets ten windows a second, and each acknowledgement is timed, in alternating blocks of
SECONDS without and with 50 clients that watch. Then a browser opens the fleet and a machine while the windows go on,
and steps are tried on the model.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import random
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple
from urllib.parse import SplitResult, urlsplit

from servotwin.messages import Channel, WindowMessage, checksum, encode, pack_channel
from servotwin.store.records import EvidenceRecord, Incoming, MessageKind, WorkResult
from servotwin.store.store import open_store
from servotwin.twin.evidence_rows import plain

MACHINES, WATCHERS, RATE_HZ, PAIRS, SECONDS = 1000, 50, 10.0, 12, 10.0
SETTLE_S = 1.0
"""Left out at the begin of each block: clients connect or leave."""
_TWIN = """[service]
port = 0
workers = 1
log_level = "error"
[models.axis]
servo = "paper"
[models.axis.twin]
policy = "paper"
[servos]
"m-*" = "axis"
"""
_TICKS = os.sysconf("SC_CLK_TCK")


def fill(folder: Path) -> None:
    """Make a store with one window, estimate and trend of each machine: only their number matters."""
    store, now = open_store(f"sqlite:///{folder}/twin.db"), time.time()
    names = [f"m-{number:04d}" for number in range(MACHINES)]
    digest = hashlib.sha256(b"none").digest()
    bare = [Incoming(name, MessageKind.WINDOW, "b/1", b"none", "", digest, now) for name in names]
    store.put([each._replace(boot="b", sequence=1) for each in bare])
    while leases := store.lease("me", 1000, 60.0, now):
        made = []
        for lease in leases:
            gap, window = 0.035 + 0.0175 * (int(lease.servo[2:]) % 17), lease.messages[0].id
            trend = {"time": 0.0, "mean": [gap, 1e-6, 0.0], "covariance": [8e-7, 0, 0, 0, 1e-14, 0, 0, 0, 0]}
            rows = (
                EvidenceRecord("estimate", window, plain({}), 1, gap, 9e-4, "ok"),
                EvidenceRecord("trend", window, plain(trend), gap=gap, std=9e-4),
            )
            done = tuple(message.id for message in lease.messages)
            made.append(WorkResult(lease.servo, lease.serial, lease.state, None, done, rows, (), (), ()))
        assert all(store.commit(made, now))
    store.close()


@contextmanager
def twin() -> Iterator[tuple[int, str]]:
    """A started twin: process id and URL."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "twin.toml").write_text(_TWIN)
        fill(folder)
        command = [sys.executable, "-m", "servotwin", "twin", "--config", str(folder / "twin.toml")]
        running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert running.stdout is not None
        try:
            yield running.pid, running.stdout.readline().split()[-1]
        finally:
            running.terminate()
            running.communicate()


class Edges(Thread):
    """Sends windows at a steady rate, of one machine after the other, and times each acknowledgement (s)."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self._address, self._done, self.times = urlsplit(url).netloc, Event(), list[float]()
        draw = random.Random(1)
        self._channels: tuple[Channel, ...] = tuple(
            pack_channel(name, unit, [draw.gauss(0, 1) for _ in range(400)])
            for name, unit in (("position", "m"), ("theta_m", "rad"))
        )

    def run(self) -> None:
        """Send until it is stopped."""
        connection, begun, number = HTTPConnection(self._address, timeout=30.0), time.monotonic(), 0
        while not self._done.wait(max(0.0, begun + number / RATE_HZ - time.monotonic())):
            sequence, servo = 10 + number // 20, f"m-{number % 20:04d}"
            start = float(sequence)
            sent = WindowMessage(
                servo, "b", sequence, start, 1000.0, self._channels, (), 0, "m", "test", checksum(self._channels)
            )
            path, number, before = f"/v1/servos/{servo}/windows/b/{sequence}", number + 1, time.perf_counter()
            connection.request("PUT", path, encode(sent), {"content-type": "application/msgpack"})
            answer = connection.getresponse()
            answer.read()
            assert answer.status == 201, answer.status
            self.times.append(time.perf_counter() - before)
        connection.close()

    def stop(self) -> None:
        """End it."""
        self._done.set()
        self.join()


class Watchers:
    """Clients that read the fleet's events, in a process of their own: they must not hold up who times the edges.

    The process lives through all blocks, so that its start costs none of them anything.
    """

    def __init__(self, url: str) -> None:
        context = get_context("spawn")
        self._line, other = context.Pipe()
        self._process = context.Process(target=_watch, args=(url, other), daemon=True)
        self._process.start()
        self.set(0)

    def set(self, number: int) -> None:
        """Have so many clients watch; returns once they do."""
        self._line.send(number)
        assert self._line.recv() == number

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()


def _watch(url: str, line: Connection) -> None:
    asyncio.run(_follow(urlsplit(url), line))


async def _follow(address: SplitResult, line: Connection) -> None:
    clients: list[asyncio.Task[None]] = []
    while True:
        number = await asyncio.to_thread(line.recv)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        opened = [asyncio.Event() for _ in range(number)]
        clients = [asyncio.create_task(_read(address, each)) for each in opened]
        await asyncio.gather(*(each.wait() for each in opened))
        line.send(number)


async def _read(address: SplitResult, opened: asyncio.Event) -> None:
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    try:
        writer.write(b"GET /v1/fleet/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while await reader.read(65536):
            opened.set()
        raise SystemExit("the twin ended a stream")
    finally:
        writer.close()


def processor_s(pid: int) -> float:
    """Processor time of a process without its children, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


class Block(NamedTuple):
    """Acknowledgements (s) and the twin's processor time (share of a core) of one block."""

    times: list[float]
    used: float


def watched(pid: int, url: str, edges: Edges, seconds: float) -> dict[str, float]:
    """What 50 watchers cost the twin and its acknowledgements.

    Blocks without and with them follow each other in pairs, first one and then the other in front, so that what the
    machine does meanwhile meets both alike. The interval is a bootstrap over pairs.
    """
    clients, pairs = Watchers(url), []
    try:
        for turn in range(PAIRS):
            order = (0, WATCHERS) if turn % 2 == 0 else (WATCHERS, 0)
            blocks = {number: _block(pid, clients, number, edges, seconds) for number in order}
            pairs.append((blocks[0], blocks[WATCHERS]))
    finally:
        clients.stop()
    without, with_them = ([block for pair in pairs for block in [pair[k]]] for k in (0, 1))
    found = {
        "core share without, %": 100 * statistics.mean(each.used for each in without),
        "core share with 50 watchers, %": 100 * statistics.mean(each.used for each in with_them),
    }
    for name, share in (("p50", 0.5), ("p99", 0.99)):
        found[f"acknowledgement {name} without, ms"] = 1e3 * _pooled(without, share)
        found[f"acknowledgement {name} with, ms"] = 1e3 * _pooled(with_them, share)
        low, high = _interval(pairs, share)
        found[f"difference of {name}, low end of 95 %, ms"] = 1e3 * low
        found[f"difference of {name}, high end of 95 %, ms"] = 1e3 * high
    found["acknowledgements"] = float(sum(len(block.times) for pair in pairs for block in pair))
    return found


def _block(pid: int, clients: Watchers, number: int, edges: Edges, seconds: float) -> Block:
    clients.set(number)
    time.sleep(SETTLE_S)
    first, before, begun = len(edges.times), processor_s(pid), time.monotonic()
    time.sleep(seconds)
    return Block(edges.times[first:], (processor_s(pid) - before) / (time.monotonic() - begun))


def _pooled(blocks: Iterable[Block], share: float) -> float:
    return quantile([value for block in blocks for value in block.times], share)


def _interval(pairs: list[tuple[Block, Block]], share: float) -> tuple[float, float]:
    """95 % interval of a quantile with watchers less that without, s."""
    draw = random.Random(2)
    found = []
    for _ in range(1000):
        chosen = draw.choices(pairs, k=len(pairs))
        found.append(_pooled([pair[1] for pair in chosen], share) - _pooled([pair[0] for pair in chosen], share))
    return quantile(found, 0.025), quantile(found, 0.975)


def quantile(values: list[float], share: float) -> float:
    """Value below which a share lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def browser(url: str, seconds: float) -> dict[str, float]:
    """First paint of the fleet, weight of the page, and how busy its main thread is while windows arrive."""
    from playwright.sync_api import sync_playwright

    found: dict[str, float] = {}
    with sync_playwright() as engine:
        opened = engine.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        page = opened.new_page(viewport={"width": 1280, "height": 900})
        paints = []
        for _ in range(5):
            page.goto("about:blank")
            page.goto(url)
            page.wait_for_selector(".rows .row")
            paints.append(page.evaluate("performance.now()"))
        found["rows of 1000 machines shown, ms (median of 5)"] = statistics.median(paints)
        fresh = opened.new_context().new_page()
        fresh.goto(url)
        fresh.wait_for_selector(".rows .row")
        found["weight of the page, kB compressed"] = fresh.evaluate(_WEIGHT) / 1e3
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        for name in ("fleet", "machine"):
            page.evaluate(f"location.hash = '#/{'' if name == 'fleet' else 'machine/m-0001'}'")
            page.wait_for_timeout(3000)
            before = _task_s(session)
            page.wait_for_timeout(1000 * seconds)
            found[f"main thread busy, {name}, %"] = 100 * (_task_s(session) - before) / seconds
        opened.close()
    return found


_WEIGHT = """[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]
    .filter((each) => /\\/$|static/.test(each.name)).reduce((sum, each) => sum + each.encodedBodySize, 0)"""


def _task_s(session: Any) -> float:
    metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
    return float(metrics["TaskDuration"])


def what_if(url: str, number: int = 150) -> dict[str, float]:
    """Times of tried steps over HTTP: while gap and dead zone are dragged, and while gains are."""
    connection, found = HTTPConnection(urlsplit(url).netloc, timeout=60.0), {}

    def ask(**asked: object) -> tuple[float, Any]:
        before = time.perf_counter()
        connection.request("POST", "/v1/servos/m-0001/what-if", json.dumps({"gap": 0.1, **asked}))
        answer = connection.getresponse()
        body = json.loads(answer.read())
        assert answer.status == 200, body
        return time.perf_counter() - before, body

    gains = ask()[1]["gains"]
    gains.pop("type", None)
    while ask()[1]["map"]["left"]:
        time.sleep(0.2)
    drags: dict[str, Callable[[int], dict[str, object]]] = {
        "gap and dead zone": lambda k: {"gap": 0.05 + 1e-3 * k, "k_dz": 0.5 + 0.01 * k},
        "gains": lambda k: {"gains": {**gains, "Kp": gains["Kp"] * (0.8 + 1e-3 * k)}},
    }
    for name, drag in drags.items():
        times = []
        for k in range(number):
            spent = ask(**drag(k))[0]
            times.append(spent)
            time.sleep(max(0.0, 0.06 - spent))
        found[f"step and map place, {name}, p95, ms"] = 1e3 * quantile(times, 0.95)
        found[f"step and map place, {name}, median, ms"] = 1e3 * quantile(times, 0.5)
    return found


def main(seconds: float = SECONDS) -> None:
    """Measure everything and print it."""
    with twin() as (pid, url):
        edges = Edges(url)
        edges.start()
        time.sleep(3.0)
        show(watched(pid, url, edges, seconds))
        show(browser(url, seconds))
        edges.stop()
        show(what_if(url))
    with suppress(OSError):
        print(f"load of the machine at the end: {os.getloadavg()[0]:.1f}")


def show(figures: dict[str, float]) -> None:
    """Print figures, one a line."""
    for name, value in figures.items():
        print(
            f"{name}: {value:.3g}" if not re.search("acknowledgements$", name) else f"{name}: {value:.0f}", flush=True
        )


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS)
