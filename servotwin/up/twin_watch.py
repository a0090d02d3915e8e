"""What the twin says of itself and of its servos, asked every other second from a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from http.client import HTTPConnection, HTTPException
from math import nan, sqrt
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgspec

from servotwin.estimation.estimate import NORMAL_95

EVERY_S, TIMEOUT_S = 2.0, 5.0
FIRST, LATER = 20, 4
"""Windows that are looked through for the newest estimate, at first and later on."""
METRICS = {
    'servotwin_messages_total{kind="window",put="new"}': "windows",
    'servotwin_evidence_total{kind="estimate"}': "estimates",
    'servotwin_evidence_total{kind="update"}': "updates",
    "servotwin_workers_lost_total": "workers lost",
}
OK = "ok"
_REFUSED = "servotwin_refused_total{"


class Estimated(NamedTuple):
    """The newest estimate of a servo that was OK.

    Attributes
    ----------
    boot, time : str, float
        Boot of the edge, and sample time in it, s.
    gap : float
        rad.
    interval : (float, float)
        rad, 95 %.
    status : str
        Of the newest estimate of all.
    rate, rate_half : float
        rad/s, wear by the trend, and half its 95 % interval; NaN before there is one.
    """

    boot: str
    time: float
    gap: float
    interval: tuple[float, float]
    status: str
    rate: float = nan
    rate_half: float = nan


class Twin(NamedTuple):
    """What the twin said.

    Attributes
    ----------
    waiting : int
        Messages not yet worked on.
    age : float
        s since the oldest of them came.
    counts : dict of str to int
        Since its start, by the names of `METRICS`, and "refused".
    """

    waiting: int
    age: float
    counts: dict[str, int]


class TwinWatch:
    """Asks, and keeps the last answer.

    Parameters
    ----------
    url, token : str
    servos : sequence of str

    Attributes
    ----------
    twin : Twin or None
        None: it did not answer.
    estimates : dict of str to Estimated
        The newest of each servo.
    """

    def __init__(self, url: str, token: str, servos: Sequence[str]) -> None:
        parts = urlsplit(url)
        self._place, self._servos = (parts.hostname or "", parts.port), servos
        self._headers = {"authorization": f"Bearer {token}"}
        self.twin: Twin | None = None
        self.estimates: dict[str, Estimated] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="twin watch", daemon=True)

    def begin(self) -> None:
        """Ask from now on."""
        self._thread.start()

    def end(self) -> None:
        """Ask no more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            line = HTTPConnection(*self._place, timeout=TIMEOUT_S)
            with suppress(OSError, HTTPException, msgspec.MsgspecError, KeyError, TypeError, ValueError):
                while not self._stop.is_set():
                    self.twin = self._ask(line)
                    self._stop.wait(EVERY_S)
            line.close()
            self.twin = None
            self._stop.wait(0.2)

    def _ask(self, line: HTTPConnection) -> Twin:
        waiting = msgspec.json.decode(self._get(line, "/healthz"))["waiting"]
        counts = counted(self._get(line, "/metrics").decode())
        for servo in self._servos:
            limit = LATER if servo in self.estimates else FIRST
            links = msgspec.json.decode(self._get(line, f"/v1/servos/{servo}/audit?limit={limit}"))
            newest = newest_estimate(links)
            if newest is not None:
                self.estimates[servo] = newest
        return Twin(waiting["messages"], waiting["age"], counts)

    def _get(self, line: HTTPConnection, path: str) -> bytes:
        line.request("GET", path, headers=self._headers)
        response = line.getresponse()
        data = response.read()
        if response.status not in (200, 503):
            raise HTTPException(f"{path}: {response.status}")
        return data


def counted(metrics: str) -> dict[str, int]:
    """Of Prometheus' text, what is shown."""
    counts = dict.fromkeys([*METRICS.values(), "refused"], 0)
    for line in metrics.splitlines():
        name, _, value = line.rpartition(" ")
        if name in METRICS:
            counts[METRICS[name]] += int(float(value))
        elif name.startswith(_REFUSED):
            counts["refused"] += int(float(value))
    return counts


def newest_estimate(links: list[dict[str, Any]]) -> Estimated | None:
    """Of the evidence chain, newest window first; None: no window of them was estimated well."""
    status = ""
    for link in links:
        found = {each["kind"]: each for each in link["found"]}
        if "estimate" not in found:
            continue
        status = status or found["estimate"]["status"]
        if found["estimate"]["status"] == OK:
            estimate = found["estimate"]["body"]["estimate"]
            low, high = estimate["interval"]
            told = estimate["time"], estimate["gap"], (low, high), status
            return Estimated(link["window"]["boot"], *told, *_wear(found.get("trend")))
    return None


def _wear(trend: dict[str, Any] | None) -> tuple[float, float]:
    """Rate and half its interval: second place of the trend's state, gap before and offset behind."""
    if trend is None:
        return nan, nan
    return trend["body"]["mean"][1], NORMAL_95 * sqrt(trend["body"]["covariance"][4])
