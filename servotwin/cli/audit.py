"""`servotwin audit` and `servos`: the evidence chain of a servo, from a twin's store or its service."""

from __future__ import annotations

import json as jsons
import ssl
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlsplit
from urllib.request import HTTPRedirectHandler, HTTPSHandler, ProxyHandler, Request, build_opener

import msgspec

from servotwin.cli.audit_report import JsonObject, Units, lines_of, servo_lines
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
from servotwin.twin_service.command import open_existing_store
from servotwin.twin_service.fleet_reader import FleetReader
from servotwin.twin_service.http_operator import MAX_ROWS, evidence_as_json, trace_as_json
from servotwin.twin_service.reports import report_of
from servotwin.twin_service.twin_file import service_of

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
        The servo is unknown or has sent no window, or the source cannot be read.
    """
    if source.url is None:
        evidence = _read_store(servo, source.config, limit)
    else:
        evidence = _read_service(servo, source, limit)
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
        The servo is unknown, the source cannot be read, or the file not written.
    """
    if source.url is None:
        store = open_existing_store(service_of(source.config))
        try:
            known_servo(store, servo)
            text = report_of(store, FleetReader(store, lambda _: None, time.time), servo) or ""
        finally:
            store.close()
    else:
        text = _client(source)(f"/v1/servos/{quote(servo, safe='')}/report.html").decode()
    with files.atomic_output(to) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"servotwin audit: wrote {to}")


def servos(source: Source, json: bool) -> None:
    """Print every servo that has sent a message.

    Raises
    ------
    InvalidInput
        The source cannot be read.
    """
    if source.url is not None:
        get_json = _json_client(source)
        rows = _all_pages(lambda after: get_json(f"/v1/servos?limit={MAX_ROWS}&after={quote(after, safe='')}"))
    else:
        store = open_existing_store(service_of(source.config))
        try:
            rows = _all_pages(lambda after: [each._asdict() for each in store.servos(after)])
        finally:
            store.close()
    if json:
        print(msgspec.json.format(msgspec.json.encode(rows)).decode())
        return
    for line in servo_lines(rows):
        print(line)


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


def _read_store(servo: str, config: Path, limit: int) -> _ServoEvidence:
    store = open_existing_store(service_of(config))
    try:
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
    finally:
        store.close()


def _read_service(servo: str, source: Source, limit: int) -> _ServoEvidence:
    get_json, name = _json_client(source), quote(servo, safe="")
    traces = get_json(f"/v1/servos/{name}/audit?limit={limit}")
    summary = get_json(f"/v1/servos/{name}")
    if not traces:
        return _ServoEvidence({}, [], [], {})
    since = _since(trace["window"]["received"] for trace in traces)
    events = get_json(f"/v1/servos/{name}/events?since={since!r}&limit={MAX_ROWS}")
    return _ServoEvidence(summary, traces, events, get_json(f"/v1/servos/{name}/gaps?limit=1").get("machine", {}))


def _since(received: Iterable[float]) -> float:
    """Time from which events are read: an edge starts before its first window."""
    # Where the clock was set back, the oldest window is not that of the earliest time.
    return max(0.0, min(received) - _BEFORE_S)


def _json_client(source: Source) -> Callable[[str], Any]:
    """Return a function that requests JSON from the service; raises InvalidInput."""
    get = _client(source)

    def get_json(path: str) -> Any:
        text = get(path)
        try:
            return jsons.loads(text)
        except ValueError as error:
            raise InvalidInput(f"{source.url}: its answer is not JSON ({error}): is that a twin?") from None

    return get_json


def _client(source: Source) -> Callable[[str], bytes]:
    """Return a function that requests from the service; raises InvalidInput."""
    url, headers = str(source.url).rstrip("/"), {}
    if not _is_address(url):
        raise InvalidInput(f"url {url!r}: give the URL of a twin, such as https://twin:8765")
    if source.token is not None and in_clear(url):
        raise InvalidInput(f"url {url!r}: would send the token in clear to another machine; give https://")
    if source.token is not None:
        headers["Authorization"] = f"Bearer {read_secret(source.token, in_header=True, longest=MAX_TOKEN)}"
    # A request in clear goes to this computer only, and must not pass a proxy, which could read the token.
    handler = HTTPSHandler(context=_context(source.ca)) if is_encrypted(url) else ProxyHandler({})
    opener = build_opener(_NoRedirect, handler)

    def get(path: str) -> bytes:
        try:
            with opener.open(Request(url + path, headers=headers), timeout=_TIMEOUT_S) as response:
                body: bytes = response.read()
                return body
        except HTTPError as error:
            raise InvalidInput(f"{url}: {_refusal(error)}") from None
        except (URLError, HTTPException, OSError, ValueError) as error:
            # urllib wraps the error of a connection in its own.
            inner = error.reason if isinstance(error, URLError) else error
            cause = cause_of(inner, is_encrypted(url), source.ca, "--ca")
            raise InvalidInput(f"{url}: cannot be reached ({cause})") from None

    return get


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
