"""`servotwin audit`: the evidence chain for people, one line per window and per thing that followed from it."""

from __future__ import annotations

import json as jsons
import math
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote
from urllib.request import Request, urlopen

import msgspec
from rich.console import Console
from rich.table import Table

from servotwin.errors import InvalidInput
from servotwin.service.command import store_of
from servotwin.service.readapi import told
from servotwin.service.secretfile import read_secret
from servotwin.service.twinfile import service_of

DEG = 180.0 / math.pi
TIMEOUT_S = 30.0
QUIET = ("hello",)
Link = dict[str, Any]


def audit(
    servo: str, config: Path, url: str | None, token: Path | None, ca: Path | None, limit: int, json: bool
) -> None:
    """Print a servo's newest windows and what followed from them: of the store of a twin's file, or of a service.

    Raises
    ------
    InvalidInput
        Nothing is known of the servo, or whoever should know cannot be asked.
    """
    links = _of_store(servo, config, limit) if url is None else _of_service(servo, url, token, ca, limit)
    if not links:
        raise InvalidInput(f"servo {servo!r}: no window of it was ever stored")
    if json:
        print(msgspec.json.format(msgspec.json.encode(links)).decode())
        return
    Console().print(table_of(servo, links))


def table_of(servo: str, links: Iterable[Link]) -> Table:
    """The chain as a table."""
    table = Table(
        "received", "window", "what", "gap, deg", "version", "said", title=f"servo {servo}", title_style="bold"
    )
    for link in links:
        for row in _rows(link):
            table.add_row(*row)
        table.add_section()
    return table


def _rows(link: Link) -> Iterable[tuple[str, ...]]:
    window = link["window"]
    yield _time(window["received"]), f"{window['boot']}/{window['sequence']}", "window", "", "", _worked(window)
    for found in link["found"]:
        if found["kind"] not in QUIET:
            yield _row(found)
    for step in link["steps"]:
        yield _row(step["update"])
        for answer in step["answers"]:
            yield _row(answer)
        if step["effect"] is not None:
            yield from _effect(step["effect"])


def _row(found: Link) -> tuple[str, ...]:
    version = "" if found["version"] is None else str(found["version"])
    return "", "", found["kind"], _gap(found), version, found["status"]


def _effect(effect: Link) -> Iterable[tuple[str, ...]]:
    """Largest error at the window's end, before and under the version."""
    window, before, after = effect["window"], effect["before"], effect["after"]
    tails = _micrometres(None if before is None else before["tail"]), _micrometres(after["tail"])
    name = f"{window['boot']}/{window['sequence']}"
    yield "", name, "effect", _gap(after), str(after["version"]), f"error at the end {tails[0]} -> {tails[1]}"


def _gap(found: Link) -> str:
    if found["gap"] is None:
        return ""
    spread = "" if found["std"] is None else f" ± {found['std'] * DEG:.3f}"
    return f"{found['gap'] * DEG:.3f}{spread}"


def _micrometres(metres: float | None) -> str:
    return "unknown" if metres is None else f"{metres * 1e6:.1f} um"


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _worked(window: Link) -> str:
    return "waits to be worked on" if window["done"] is None else ""


def _of_store(servo: str, config: Path, limit: int) -> list[Link]:
    store = store_of(service_of(config))
    try:
        return [told(link) for link in store.audit(servo, limit=limit)]
    finally:
        store.close()


def _of_service(servo: str, url: str, token: Path | None, ca: Path | None, limit: int) -> list[Link]:
    headers = {} if token is None else {"Authorization": f"Bearer {read_secret(token)}"}
    where = f"{url.rstrip('/')}/v1/servos/{quote(servo, safe='')}/audit?limit={limit}"
    if not where.startswith(("http://", "https://")):
        raise InvalidInput(f"url {url!r}: give that of a twin, such as https://twin:8765")
    context = ssl.create_default_context(cafile=None if ca is None else str(ca)) if where.startswith("https") else None
    try:
        with urlopen(Request(where, headers=headers), timeout=TIMEOUT_S, context=context) as answer:
            return list(jsons.load(answer))
    except HTTPError as error:
        raise InvalidInput(f"{url}: {_said(error)}") from None
    except (URLError, OSError, ValueError) as error:
        raise InvalidInput(f"{url}: cannot be asked ({error})") from None


def _said(error: HTTPError) -> str:
    """What a refusal says."""
    with error:
        try:
            return str(jsons.load(error)["detail"])
        except (ValueError, KeyError, TypeError):
            return f"answers {error.code}"
