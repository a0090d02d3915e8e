"""`servotwin bench overload`: a twin that gets more windows than it can work off; edges judge its updates for real.

The twin is a process with one worker. Without triage each window would be estimated and, with the paper's policy,
answered. The rate is a multiple of the one at which the worker processes windows one by one.
"""

from __future__ import annotations

import http.client
import json
import math
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import msgspec
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.fleet.processes import ServiceProcess, check_system, children, service, used
from benchmarks.fleet.stock import readdressed
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.edge.guard import Instant, Limits
from servotwin.edge.parameters import Parameters
from servotwin.edge.supervisor import Rules, Switch, offer
from servotwin.link.seal import Sealed
from servotwin.messages import Receipt, Setting, Update, WindowMessage, checksum, decode, encode
from servotwin.messages.codec import deflated

SCHEMA = "servotwin-bench-overload/1"
NAME = "overload"
BOOT = "boot-1"
_GAP, _STEP_S = math.radians(10.0), 20.0
"""rad; s from one step to the next."""
_BEFORE_S = 10.0
"""s that an edge has run when the bench begins."""
_TWIN = """
[service]
port = 0
store = "sqlite:///twin.db"
workers = 1
log_level = "warning"

[models.axis]
servo = "paper"

[models.axis.twin]
policy = "paper"
validity_s = {validity}

[servos]
"ax-*" = "axis"
"""
_MEASURED = 20
"""Windows with which the rate without overload is measured."""
_END_S = 5.0
"""s at the end in which no window is sent, so that the last updates arrive."""


@dataclass(frozen=True)
class OverloadScale:
    """Size of a run.

    Attributes
    ----------
    servos : int
    seconds : float
    factor : float
        Rate of the windows over the rate at which one worker processes them one by one.
    validity : float
        s, of an update from the start of its window.
    places : int
        Windows that the servos send in turn.
    """

    servos: int = 12
    seconds: float = 600.0
    factor: float = 5.0
    validity: float = 60.0
    places: int = 6


QUICK, SMALL = OverloadScale(2, 15.0, places=2), OverloadScale(seconds=90.0)


@dataclass
class OverloadEdge:
    """One servo's edge: its switch, and what it saw.

    Attributes
    ----------
    latencies : list of float
        s from each window to its acknowledgement.
    applied_at : list of float
        s since the begin.
    reasons : Counter
        Receipts.
    """

    name: str
    windows: Sequence[WindowMessage]
    port: int
    latencies: list[float] = field(default_factory=list)
    applied_at: list[float] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)
    sequence: int = 0
    serial: int = 0
    switch: Switch = field(default_factory=lambda: Switch(Parameters(0, Setting(0.0))))

    def run(self, begin: float, period: float, seconds: float, phase: float) -> None:
        """Send a window every `period` s, and poll in between."""
        line, due = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60.0), phase
        while (now := time.monotonic() - begin) < seconds:
            if now >= due and now < seconds - _END_S:
                self.send(line, now)
                due += period
            else:
                wait = max(0.0, min(due if due < seconds - _END_S else seconds, seconds) - now)
                self.poll(line, begin, min(wait, 1.0))
        line.close()

    def send(self, line: http.client.HTTPConnection, now: float) -> None:
        """Send the next window, which ends now."""
        template = self.windows[self.sequence % len(self.windows)]
        start = now - template.samples / template.rate + _BEFORE_S
        version = self.switch.current.version
        window = msgspec.structs.replace(readdressed(template, self.name, self.sequence, start, version), boot=BOOT)
        body, encoding = deflated(encode(window))
        headers = {"content-encoding": encoding} if encoding else {}
        sent = time.monotonic()
        status, _ = _ask(line, "PUT", f"/v1/servos/{self.name}/windows/{BOOT}/{self.sequence}", body, headers)
        if status == 201:
            self.latencies.append(time.monotonic() - sent)
            self.sequence += 1
        else:
            self.reasons[f"HTTP {status}"] += 1

    def poll(self, line: http.client.HTTPConnection, begin: float, wait: float) -> None:
        """Get messages, judge the updates, and send the receipts."""
        path = f"/v1/servos/{self.name}/outgoing?after={self.serial}&wait={wait:.3f}"
        status, body = _ask(line, "GET", path, b"", {})
        for data in msgspec.msgpack.decode(body, type=list[bytes]) if status == 200 else ():
            sealed = msgspec.msgpack.decode(data, type=Sealed)
            self.serial = max(self.serial, sealed.serial)
            update = decode(sealed.body)
            if isinstance(update, Update):
                now = time.monotonic() - begin
                self._judge(line, update, now)

    def _judge(self, line: http.client.HTTPConnection, update: Update, now: float) -> None:
        rate = self.windows[0].rate
        here = Instant(self.name, BOOT, int((now + _BEFORE_S) * rate), rate)
        step = offer(self.switch, update, Rules(Limits()), here, None)
        self.switch = step.state
        for receipt in step.messages:
            assert isinstance(receipt, Receipt)
            self.reasons[receipt.reason.value] += 1
            if receipt.applied:
                self.applied_at.append(now)
            _ask(line, "POST", f"/v1/servos/{self.name}/letters", encode(receipt), {})


class OverloadOutcome(NamedTuple):
    """Figures of a run.

    Attributes
    ----------
    alone, rate : float
        Windows/s processed one by one, and sent.
    windows, sent, applied : int
        Acknowledged windows; updates that came, and that were applied.
    reasons : dict of str to int
        Receipts, by reason.
    least, longest : int, float
        Updates applied at the servo with the fewest; s, longest time without one at any servo.
    latency_p50, latency_p99 : float
        s, of acknowledgements.
    lag, waiting : float, int
        s and messages, at the end of the sending.
    memory_begin, memory_end : int
        Bytes of twin and worker after a tenth of the time, and at the end.
    """

    alone: float
    rate: float
    windows: int
    sent: int
    applied: int
    reasons: dict[str, int]
    least: int
    longest: float
    latency_p50: float
    latency_p99: float
    lag: float
    waiting: int
    memory_begin: int
    memory_end: int


def overload(
    date: str = "", output: Path | None = None, scale: OverloadScale = SMALL, console: Console | None = None
) -> OverloadOutcome:
    """Overload a twin, print the figures, and write JSON on request.

    Raises
    ------
    InvalidInput
        The output cannot be written, or the system has no /proc.
    """
    console = console or Console()
    report.check(output)
    check_system()
    with TemporaryDirectory() as name, console.status(f"{scale.seconds:g} s of overload"):
        folder = Path(name)
        (folder / "twin.toml").write_text(_TWIN.format(validity=scale.validity), encoding="utf-8")
        windows = recorded(scale.places)
        with service(folder) as running:
            outcome = _outcome(running, scale, windows)
    console.print(shown(outcome))
    report.write(output, report.text(SCHEMA, date, scale=scale, outcome=outcome._asdict()), console)
    return outcome


def _outcome(running: ServiceProcess, scale: OverloadScale, windows: list[WindowMessage]) -> OverloadOutcome:
    alone = _rate_alone(running.port, windows)
    rate = scale.factor * alone
    edges = [OverloadEdge(f"ax-{n:03d}", windows, running.port) for n in range(scale.servos)]
    begin, period = time.monotonic(), scale.servos / rate
    plans = [(begin, period, scale.seconds, n / rate) for n in range(scale.servos)]
    threads = [threading.Thread(target=edge.run, args=plan) for edge, plan in zip(edges, plans, strict=True)]
    for thread in threads:
        thread.start()
    time.sleep(0.1 * scale.seconds)
    first = _memory(running.process.pid)
    time.sleep(max(0.0, begin + scale.seconds - _END_S - time.monotonic()))
    waiting, last = _waiting(running.port), _memory(running.process.pid)
    for thread in threads:
        thread.join()
    reasons = sum((edge.reasons for edge in edges), Counter[str]())
    latencies = sorted(latency for edge in edges for latency in edge.latencies)
    return OverloadOutcome(
        alone=alone,
        rate=rate,
        windows=len(latencies),
        sent=sum(number for reason, number in reasons.items() if not reason.startswith("HTTP")),
        applied=reasons["applied"],
        reasons=dict(reasons),
        least=min(len(edge.applied_at) for edge in edges),
        longest=max(longest_pause(edge.applied_at, scale.seconds - _END_S) for edge in edges),
        latency_p50=_quantile(latencies, 0.5),
        latency_p99=_quantile(latencies, 0.99),
        lag=waiting["lag"],
        waiting=int(waiting["messages"]),
        memory_begin=first,
        memory_end=last,
    )


def recorded(count: int) -> list[WindowMessage]:
    """Windows of the paper's loop at a gap that does not change, without their voltage.

    Each shows the gap; with the voltage the twin would see that the loop did not run on the edge's setting.
    """
    scenario = Scenario.preset("fig15-sampled").replace(gap=_GAP, duration=_STEP_S * (count + 1.5), name="axis")
    return [without_voltage(window) for window in cosimulate(scenario).windows[1 : count + 1]]


def without_voltage(window: WindowMessage) -> WindowMessage:
    """Copy a window without its voltage, which would show a loop that ran on another setting."""
    channels = tuple(channel for channel in window.channels if channel.name != "voltage")
    return msgspec.structs.replace(window, channels=channels, crc=checksum(channels))


def longest_pause(times: Sequence[float], seconds: float) -> float:
    """Longest time without an event, from the begin to the end (s)."""
    known = [0.0, *times, max(seconds, *times)] if times else [0.0, seconds]
    return max(later - earlier for earlier, later in pairwise(known))


def _rate_alone(port: int, windows: Sequence[WindowMessage]) -> float:
    """Windows/s that the twin processes one after the other; the first ones, which compile, do not count."""
    edge, line = OverloadEdge("ax-alone", windows, port), http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
    for number in range(_MEASURED):
        edge.send(line, 4.0 * number)
        while _waiting(port)["messages"]:
            time.sleep(0.6)  # a backlog that was read is served again for so long
        if number == 1:
            compiled = _work_seconds(line)
    seconds, count = (end - begin for end, begin in zip(_work_seconds(line), compiled, strict=True))
    line.close()
    return count / seconds


def _work_seconds(line: http.client.HTTPConnection) -> tuple[float, float]:
    """Seconds of the worker so far, and the number of leases."""
    text = _ask(line, "GET", "/metrics", b"", {})[1].decode()
    found = dict(row.rsplit(" ", 1) for row in text.splitlines() if row.startswith("servotwin_work_seconds_"))
    return float(found["servotwin_work_seconds_sum"]), float(found["servotwin_work_seconds_count"])


def _waiting(port: int) -> dict[str, float]:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
    _, body = _ask(line, "GET", "/healthz", b"", {})
    line.close()
    waiting: dict[str, float] = json.loads(body)["waiting"]
    return waiting


def _memory(pid: int) -> int:
    usages = [used(each) for each in (pid, *children(pid))]
    return sum(usage.memory for usage in usages if usage is not None)


def _ask(
    line: http.client.HTTPConnection, method: str, path: str, body: bytes, headers: dict[str, str]
) -> tuple[int, bytes]:
    line.request(method, path, body or None, headers)
    response = line.getresponse()
    return response.status, response.read()


def _quantile(values: Sequence[float], share: float) -> float:
    return values[min(len(values) - 1, int(share * len(values)))] if values else math.nan


def shown(outcome: OverloadOutcome) -> Table:
    """A row for each figure."""
    result = Table(title="overload: updates of a twin that gets too many windows", title_justify="left", box=None)
    result.add_column("figure")
    result.add_column("value", justify="right")
    share = outcome.applied / outcome.sent if outcome.sent else math.nan
    reasons = ", ".join(f"{number} {reason}" for reason, number in sorted(outcome.reasons.items()))
    for name, value in (
        ("windows/s, one by one", f"{outcome.alone:.3g}"),
        ("windows/s, sent", f"{outcome.rate:.3g}"),
        ("windows acknowledged", f"{outcome.windows}"),
        ("updates sent, applied", f"{outcome.sent}, {outcome.applied} ({100.0 * share:.1f} %)"),
        ("receipts", reasons),
        ("updates applied, fewest of a servo", f"{outcome.least}"),
        ("longest time without an update, s", f"{outcome.longest:.1f}"),
        ("acknowledgement, s (50 %, 99 %)", f"{outcome.latency_p50:.3f}, {outcome.latency_p99:.3f}"),
        ("lag at the end, s; messages waiting", f"{outcome.lag:.1f}; {outcome.waiting}"),
        ("memory after a tenth, at the end, MB", f"{outcome.memory_begin / 1e6:.0f}, {outcome.memory_end / 1e6:.0f}"),
    ):
        result.add_row(name, value)
    return result
