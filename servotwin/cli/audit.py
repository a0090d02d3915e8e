"""`servotwin audit` and `servos`: the evidence chain of a servo, from a twin's store or its service."""

from __future__ import annotations

import json as jsons
import ssl
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlsplit
from urllib.request import HTTPRedirectHandler, HTTPSHandler, ProxyHandler, Request, build_opener

import msgspec

from servotwin.cli.audit_report import JsonObject, Units, lines_of, servo_lines
from servotwin.cli.check import store_to_read, telling_after
from servotwin.config.files import read_secret
from servotwin.config.table import did_you_mean
from servotwin.dashboard.series import machine_series
from servotwin.errors import InvalidInput
from servotwin.link.connection_errors import cause_of
from servotwin.link.seal import MAX_TOKEN
from servotwin.link.url import in_clear, is_encrypted
from servotwin.runtime import files
from servotwin.store.records import ServoSummary
from servotwin.store.store import Store
from servotwin.twin_service.fleet_reader import FleetReader
from servotwin.twin_service.http_operator import MAX_ROWS, evidence_as_json, trace_as_json
from servotwin.twin_service.reports import report_of

_TIMEOUT_S = 30.0
_BEFORE_S = 60.0
"""Events without a window are shown from this time before the first window on, s."""


@dataclass(frozen=True)
class Source:
    """Source of the evidence: a service where a URL is set, otherwise the store that a twin's file names.

    Attributes
    ----------
    config : Path
        The twin's file.
    url : str or None
        https://twin:8765
    token, ca : Path or None
        File with an operator's token; certificates against which the service's is checked.
    """

    config: Path
    url: str | None = None
    token: Path | None = None
    ca: Path | None = None


class _ServoEvidence(NamedTuple):
    """A servo, its windows, the events without a window, and the facts of its machine, in the form of the API."""

    servo: JsonObject
    traces: list[JsonObject]
    events: list[JsonObject]
    machine: JsonObject


def audit(servo: str, source: Source, limit: int, changes: bool, json: bool) -> None:
    """Print a servo's newest windows with the estimates, updates and receipts that followed.

    Parameters
    ----------
    servo : str
    source : Source
    limit : int
        Largest number of windows.
    changes : bool
        Leave out windows that led to an estimate only.
    json : bool
        Print the evidence chains as JSON, in the form of the API.

    Raises
    ------
    InvalidInput
        The servo is unknown or has sent no window, the source cannot be read, or its store is damaged.
    """
    with _opened(source) as opened:
        if isinstance(opened, Store):
            evidence = _read_store(servo, opened, limit)
        else:
            evidence = _read_service(servo, opened, limit)
        if not evidence.traces:
            raise InvalidInput(f"servo {servo!r}: has sent messages, but no window yet")
        if json:
            print(msgspec.json.format(msgspec.json.encode(evidence.traces)).decode())
            return
        servo_row, traces, events, machine = evidence
        for line in lines_of(servo_row, traces, events, Units.of(machine), changes):
            print(line)


def write_report(servo: str, source: Source, to: Path) -> None:
    """Write the report of a machine: one HTML file that needs no other.

    Raises
    ------
    InvalidInput
        The servo is unknown, the source cannot be read, its store is damaged, or the file not written.
    """
    with _opened(source) as opened:
        if isinstance(opened, Store):
            known_servo(opened, servo)
            text = report_of(opened, FleetReader(opened, lambda _: None, time.time), servo) or ""
        else:
            text = opened.get(f"/v1/servos/{quote(servo, safe='')}/report.html").decode()
        with files.atomic_output(to) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"written: {to}")


def servos(source: Source, json: bool) -> None:
    """Print every servo that has sent a message.

    Raises
    ------
    InvalidInput
        The source cannot be read, or its store is damaged.
    """
    with _opened(source) as opened:
        rows = _all_pages(_servos_of(opened))
        if json:
            print(msgspec.json.format(msgspec.json.encode(rows)).decode())
            return
        for line in servo_lines(rows):
            print(line)


def _servos_of(opened: Store | _Service) -> Callable[[str], list[JsonObject]]:
    """Return a function that reads the servos after a name."""
    if isinstance(opened, Store):
        return lambda after: [each._asdict() for each in opened.servos(after)]
    return lambda after: opened.get_json(f"/v1/servos?limit={MAX_ROWS}&after={quote(after, safe='')}")


def _all_pages(page: Callable[[str], list[JsonObject]]) -> list[JsonObject]:
    """Read all servos page by page; `page` returns those after a name."""
    rows: list[JsonObject] = []
    while batch := page(rows[-1]["servo"] if rows else ""):
        rows += batch
    return rows


def known_servo(store: Store, servo: str) -> ServoSummary:
    """Return a servo's summary; raises InvalidInput where it has never sent a message."""
    summary = store.servo(servo)
    if summary is None:
        names = [row["servo"] for row in _all_pages(lambda after: [each._asdict() for each in store.servos(after)])]
        raise InvalidInput(f"servo {servo!r}: has never sent a message to this twin{did_you_mean(servo, names)}")
    return summary


def _read_store(servo: str, store: Store, limit: int) -> _ServoEvidence:
    summary, traces = known_servo(store, servo), store.audit(servo, limit=limit)
    if not traces:
        return _ServoEvidence({}, [], [], {})
    events = store.events(servo, _since(trace.window.received for trace in traces), MAX_ROWS)
    series = store.reading(lambda connection: machine_series(connection, servo, 1))
    return _ServoEvidence(
        summary._asdict(),
        [trace_as_json(trace) for trace in traces],
        [evidence_as_json(each) for each in events],
        asdict(series["machine"]),
    )


def _read_service(servo: str, service: _Service, limit: int) -> _ServoEvidence:
    name = quote(servo, safe="")
    traces = service.get_json(f"/v1/servos/{name}/audit?limit={limit}")
    summary = service.get_json(f"/v1/servos/{name}")
    if not traces:
        return _ServoEvidence({}, [], [], {})
    since = _since(trace["window"]["received"] for trace in traces)
    events = service.get_json(f"/v1/servos/{name}/events?since={since!r}&limit={MAX_ROWS}")
    machine = service.get_json(f"/v1/servos/{name}/gaps?limit=1").get("machine", {})
    return _ServoEvidence(summary, traces, events, machine)


def _since(received: Iterable[float]) -> float:
    """Time from which events are read: an edge starts before its first window."""
    # Where the clock was set back, the oldest window is not that of the earliest time.
    return max(0.0, min(received) - _BEFORE_S)


def _opened(source: Source) -> AbstractContextManager[Store | _Service]:
    """Open a source for a block that shows what is in it; after the block it says where the store is damaged."""
    return store_to_read(source.config) if source.url is None else _service_to_read(source)


@contextmanager
def _service_to_read(source: Source) -> Iterator[_Service]:
    service = _Service(source)
    with telling_after(service.require_sound):
        yield service


class _Service:
    """A twin's service; its methods raise InvalidInput."""

    def __init__(self, source: Source) -> None:
        self._url, self._ca, self._headers = str(source.url).rstrip("/"), source.ca, dict[str, str]()
        self._answers = False
        if not _is_address(self._url):
            raise InvalidInput(f"url {self._url!r}: give the URL of a twin, such as https://twin:8765")
        if source.token is not None and in_clear(self._url):
            raise InvalidInput(f"url {self._url!r}: would send the token in clear to another machine; give https://")
        if source.token is not None:
            token = read_secret(source.token, in_header=True, longest=MAX_TOKEN)
            self._headers["Authorization"] = f"Bearer {token}"
        # A request in clear goes to this computer only, and must not pass a proxy, which could read the token.
        encrypted = is_encrypted(self._url)
        self._opener = build_opener(
            _NoRedirect, HTTPSHandler(context=_context(self._ca)) if encrypted else ProxyHandler({})
        )

    def get(self, path: str) -> bytes:
        """Request a path."""
        try:
            with self._open(path, self._headers) as response:
                self._answers, body = True, bytes(response.read())
                return body
        except HTTPError as error:
            self._answers = True
            raise InvalidInput(f"{self._url}: {_refusal(error)}") from None
        except (URLError, HTTPException, OSError, ValueError) as error:
            # urllib wraps the error of a connection in its own.
            inner = error.reason if isinstance(error, URLError) else error
            cause = cause_of(inner, is_encrypted(self._url), self._ca, "--ca")
            raise InvalidInput(f"{self._url}: cannot be reached ({cause})") from None

    def get_json(self, path: str) -> Any:
        """Request JSON."""
        text = self.get(path)
        try:
            return jsons.loads(text)
        except ValueError as error:
            raise InvalidInput(f"{self._url}: its answer is not JSON ({error}): is that a twin?") from None

    def require_sound(self) -> None:
        """Say the damage of the twin's store, where its health, which needs no token, tells any."""
        damage, aside = "", dict[str, str]()
        with suppress(HTTPException, OSError, ValueError, LookupError, TypeError):
            health = jsons.loads(self._health() if self._answers else b"")
            damage, aside = health["damage"], health.get("set_aside", {})  # which an older twin does not have
        if damage or aside:
            what = "store" if damage else f"record of {' and '.join(aside)}"
            why = damage or "; ".join(aside.values())
            raise InvalidInput(f"{self._url}: the twin's {what} is damaged ({why}); call `servotwin twin check` there")

    def _health(self) -> bytes:
        try:
            with self._open("/healthz", {}) as response:
                return bytes(response.read())
        except HTTPError as error:  # 503 where a part is not healthy
            with error:
                return error.read()

    def _open(self, path: str, headers: dict[str, str]) -> Any:
        return self._opener.open(Request(self._url + path, headers=headers), timeout=_TIMEOUT_S)


def _is_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False


class _NoRedirect(HTTPRedirectHandler):
    """Follows no redirect, which could send the token to another service."""

    def redirect_request(self, *_args: Any) -> None:
        """Refuse every redirect."""


def _context(ca: Path | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=None if ca is None else str(ca))
    except (OSError, ssl.SSLError) as error:
        raise InvalidInput(f"{ca}: holds no certificates that can be read ({error})") from None


def _refusal(error: HTTPError) -> str:
    """Reason in the body of an error response."""
    with error:
        try:
            return str(jsons.load(error)["detail"])
        except (ValueError, KeyError, TypeError):
            return f"responds with status {error.code}"
