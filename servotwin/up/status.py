"""Status of the twin, over HTTP, and of each servo: its machine, edge, link and newest estimate."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from http.client import HTTPConnection, HTTPException
from math import degrees, nan, sqrt
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgspec

from servotwin.config.own_units import VOLTS_METRES, OwnUnits
from servotwin.drives.simulated.machine_state import MachineState, read_state
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge_process.monitoring import read_status
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95
from servotwin.plant.own_units import own_units
from servotwin.up.plan import MACHINE, ServoPlan

_POLL_S, _TIMEOUT_S = 2.0, 5.0
_FIRST_WINDOWS, _WINDOWS, _MOST_WINDOWS = 20, 4, 1000
"""Windows that are searched for the newest estimate, at first and later, and most that the twin shows at once."""
_METRICS = {
    'servotwin_messages_total{kind="window",put="new"}': "windows",
    'servotwin_evidence_total{kind="estimate"}': "estimates",
    'servotwin_evidence_total{kind="update"}': "updates",
    "servotwin_workers_lost_total": "workers lost",
}
OK = "ok"
_REFUSED = "servotwin_refused_total{"


class ServoEstimate(NamedTuple):
    """Newest estimate of a servo with status OK.

    Attributes
    ----------
    boot, time : str, float
        Boot of the edge, and sample time in it, s.
    gap : float
        rad.
    interval : (float, float)
        rad, 95 %.
    status : str
        Of the newest estimate, whatever it is.
    rate, rate_half : float
        rad/s, wear rate of the trend and half of its 95 % interval; NaN without a trend.
    """

    boot: str
    time: float
    gap: float
    interval: tuple[float, float]
    status: str
    rate: float = nan
    rate_half: float = nan


class TwinStatus(NamedTuple):
    """Status of the twin.

    Attributes
    ----------
    waiting : int
        Unprocessed messages.
    age : float
        s since the oldest of them was received.
    counts : dict of str to int
        Since its start, by the names in `_METRICS`, and "refused".
    aside : tuple of str
        Servos that are set aside, because their record is damaged.
    """

    waiting: int
    age: float
    counts: dict[str, int]
    aside: tuple[str, ...] = ()


class TwinPoller:
    """Polls the twin every two seconds in a thread, and keeps its last status.

    Parameters
    ----------
    url, token : str
    servos : sequence of str

    Attributes
    ----------
    twin : TwinStatus or None
        None: it did not respond.
    estimates : dict of str to ServoEstimate
        Newest of each servo.
    """

    def __init__(self, url: str, token: str, servos: Sequence[str]) -> None:
        parts = urlsplit(url)
        self._host, self._port, self._servos = parts.hostname or "", parts.port, servos
        self._headers = {"authorization": f"Bearer {token}"}
        self.twin: TwinStatus | None = None
        self.estimates: dict[str, ServoEstimate] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="twin poller", daemon=True)

    def start(self) -> None:
        """Start polling."""
        self._thread.start()

    def stop(self) -> None:
        """Stop polling."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            connection = HTTPConnection(self._host, self._port, timeout=_TIMEOUT_S)
            with suppress(OSError, HTTPException, msgspec.MsgspecError, KeyError, TypeError, ValueError):
                while not self._stop.is_set():
                    self.twin = self._poll(connection)
                    self._stop.wait(_POLL_S)
            connection.close()
            self.twin = None
            self._stop.wait(0.2)  # before the next attempt to connect

    def _poll(self, connection: HTTPConnection) -> TwinStatus:
        health = msgspec.json.decode(self._get(connection, "/healthz"))
        waiting = health["waiting"]
        counts = read_metrics(self._get(connection, "/metrics").decode())
        for servo in self._servos:
            few = _WINDOWS if servo in self.estimates else _FIRST_WINDOWS
            newest = self._newest(connection, servo, few)
            if newest is None and waiting["messages"]:  # the newest windows may be those that wait
                newest = self._newest(connection, servo, min(_MOST_WINDOWS, waiting["messages"] + few))
            if newest is not None:
                self.estimates[servo] = newest
        return TwinStatus(waiting["messages"], waiting["age"], counts, tuple(health.get("set_aside", ())))

    def _newest(self, connection: HTTPConnection, servo: str, limit: int) -> ServoEstimate | None:
        """Newest estimate among the last windows of a servo, at most `limit`."""
        traces = msgspec.json.decode(self._get(connection, f"/v1/servos/{servo}/audit?limit={limit}"))
        # A refusal is an object: the servo is set aside, or the store cannot be read now.
        return newest_estimate(traces) if isinstance(traces, list) else None

    def _get(self, connection: HTTPConnection, path: str) -> bytes:
        connection.request("GET", path, headers=self._headers)
        response = connection.getresponse()
        data = response.read()
        if response.status not in (200, 503):
            raise HTTPException(f"{path}: {response.status}")
        return data


def read_metrics(metrics: str) -> dict[str, int]:
    """Counts from metrics in Prometheus' text format."""
    counts = dict.fromkeys([*_METRICS.values(), "refused"], 0)
    for line in metrics.splitlines():
        name, _, value = line.rpartition(" ")
        if name in _METRICS:
            counts[_METRICS[name]] += int(float(value))
        elif name.startswith(_REFUSED):
            counts["refused"] += int(float(value))
    return counts


def newest_estimate(traces: list[dict[str, Any]]) -> ServoEstimate | None:
    """Newest estimate with status OK in an evidence chain, newest window first; None: there is none."""
    status = ""
    for trace in traces:
        evidence = {each["kind"]: each for each in trace["evidence"]}
        if "estimate" not in evidence:
            continue
        status = status or evidence["estimate"]["status"]
        if evidence["estimate"]["status"] == OK:
            estimate = evidence["estimate"]["body"]["estimate"]
            low, high = estimate["interval"]
            rate, rate_half = _wear(evidence.get("trend"))
            return ServoEstimate(
                boot=trace["window"]["boot"],
                time=estimate["time"],
                gap=estimate["gap"],
                interval=(low, high),
                status=status,
                rate=rate,
                rate_half=rate_half,
            )
    return None


def _wear(trend: dict[str, Any] | None) -> tuple[float, float]:
    """Wear rate and half of its 95 % interval; the trend's state is (gap, rate, offset)."""
    if trend is None or trend["body"].get("updates", 2) < 2:  # one window alone tells nothing of wear
        return nan, nan
    return trend["body"]["mean"][1], NORMAL_95 * sqrt(trend["body"]["covariance"][4])


class EstimateError(NamedTuple):
    """An estimate compared with the true gap.

    Attributes
    ----------
    estimate : ServoEstimate
    truth : float or None
        deg, total gap of the machine at the time of the estimate; None: that time is unknown.
    age : float or None
        s of machine time since then.
    """

    estimate: ServoEstimate
    truth: float | None
    age: float | None

    @property
    def error(self) -> float | None:
        """Estimate minus truth, deg."""
        return None if self.truth is None else degrees(self.estimate.gap) - self.truth

    @property
    def inside(self) -> bool | None:
        """True where the interval covers the truth; None: the truth is unknown."""
        low, high = map(degrees, self.estimate.interval)
        return None if self.truth is None else low <= self.truth <= high


class ServoStatus(NamedTuple):
    """Status of a servo.

    Attributes
    ----------
    plan : ServoPlan
    machine : MachineState or None
    edge : dict
        Status file of its edge; empty before the first.
    estimate : EstimateError or None
    cut : int
        Windows cut since the start.
    outage : float
        s until the present outage of its link ends; 0: there is none.
    restarts : int
        Of its machine and its edge.
    units : OwnUnits
        In which the edge's status counts.
    """

    plan: ServoPlan
    machine: MachineState | None
    edge: dict[str, Any]
    estimate: EstimateError | None
    cut: int
    outage: float
    restarts: int
    units: OwnUnits = VOLTS_METRES


class ServoReader:
    """Reads the files of one servo.

    Parameters
    ----------
    plan : ServoPlan
    folder : Path
        Folder of the servo.
    """

    def __init__(self, plan: ServoPlan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        self._begun = time.time()
        self._settings = MachineSettings.load(folder / MACHINE)
        self._origins: dict[str, float] = {}
        self._cuts: dict[str, int] = {}

    def read(self, estimate: ServoEstimate | None, outage: float, restarts: int) -> ServoStatus:
        """Read the present status."""
        machine, edge = self.machine(), self._edge()
        boot = edge.get("boot", "")
        if boot:
            self._cuts[boot] = max(self._cuts.get(boot, 0), edge.get("windows_cut") or 0)
            self._note_origin(boot, machine, edge)
        return ServoStatus(
            plan=self._plan,
            machine=machine,
            edge=edge,
            estimate=None if estimate is None else self._compare(estimate, machine),
            cut=sum(self._cuts.values()),
            outage=outage,
            restarts=restarts,
            units=own_units(self._settings.scenario.servo),
        )

    def machine(self) -> MachineState | None:
        """State of the machine in this run; None: there is none yet."""
        try:
            state = read_state(self._folder / "state.json")
        except InvalidInput:
            return None
        # A file of an earlier start counts as absent.
        return state if state is not None and state.written >= self._begun else None

    def _edge(self) -> dict[str, Any]:
        status = read_status(self._folder / "status.json") or {}
        return status if status.get("written", 0.0) >= self._begun else {}

    def _note_origin(self, boot: str, machine: MachineState | None, edge: dict[str, Any]) -> None:
        """Note the machine time at which a boot started: the edge counts its samples, the drive numbers them."""
        drive = edge.get("drive_sample")
        if boot not in self._origins and machine is not None and drive is not None:
            self._origins[boot] = machine.begun_s + (drive - edge["samples"]) / self._settings.rate

    def _compare(self, estimate: ServoEstimate, machine: MachineState | None) -> EstimateError:
        origin = self._origins.get(estimate.boot)
        if origin is None or machine is None:
            return EstimateError(estimate, None, None)
        when = origin + estimate.time
        return EstimateError(estimate, degrees(self._settings.gap_when(when)), machine.time_s - when)
