"""Webhook for alarms: its settings, and one post."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import msgspec

from servotwin.config.files import header_secret_file
from servotwin.config.keys import Form, key
from servotwin.config.table import Table
from servotwin.errors import InvalidInput
from servotwin.link.connection_errors import cause_of
from servotwin.link.url import certificates, in_clear, is_encrypted, tls_context

_REPEAT_S, _TIMEOUT_S = 3600.0, 10.0
"""s in which an alarm is posted once; for one post."""


class WebhookAway(Exception):
    """The webhook does not answer, or asks to be tried again."""


class WebhookRefused(Exception):
    """The webhook does not want this post, nor will it later."""


@dataclass(frozen=True)
class WebhookConfig:
    """Address to which alarms are posted; `secret`: not shown.

    Attributes
    ----------
    url : str
    secret : str or None
        Sent as `Authorization: Bearer SECRET`.
    ca_file : str or None
    repeat : float
        s.
    """

    url: str
    secret: str | None = None
    ca_file: str | None = None
    repeat: float = _REPEAT_S

    def __repr__(self) -> str:
        return f"WebhookConfig({self.host!r})"

    @property
    def host(self) -> str:
        """Name of the machine; the path of a webhook is often a secret itself, and is not shown."""
        return urlsplit(self.url).hostname or ""


def _url(table: Table, name: str, url: str, _folder: Path) -> str:
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.username is None
        _ = parts.port
    except ValueError:
        valid = False
    # The value is not repeated: a webhook's path is often a secret.
    if not valid or not url.isascii() or not url.isprintable() or " " in url:
        raise InvalidInput(
            f"{table.source}: {table.path(name)}: must be a URL, https://host[:port]/path, without a user"
        )
    if in_clear(url):
        raise InvalidInput(
            f"{table.source}: {table.path(name)}: sends alarms in clear to another machine: give https://"
        )
    return url


def webhook_table(
    url: Annotated[str, key(parse=_url, help="https://host[:port]/path, or http:// on this machine.")],
    secret: Annotated[
        str | None,
        key(
            "secret_file",
            form=Form.PATH,
            parse=header_secret_file,
            help="File of mode 0600; its content is sent as Authorization: Bearer CONTENT.",
        ),
    ] = None,
    ca_file: Annotated[
        str | None,
        key(
            relative=True,
            parse=certificates,
            help="Certificates that the webhook's is checked against; the system's where absent.",
        ),
    ] = None,
    repeat: Annotated[
        float,
        key("repeat_s", minimum=0.0, help="Time within which an alarm of a servo in the same words is posted once."),
    ] = _REPEAT_S,
) -> WebhookConfig:
    """Address to which each alarm is posted as JSON, until it is taken."""
    return WebhookConfig(url, secret, ca_file, repeat)


class AlarmPost(msgspec.Struct, frozen=True):
    """Body of a post.

    Attributes
    ----------
    text : str
        The same as one sentence, for services that show only that.
    servo, kind, sentence : str
    time : str
        When the twin raised the alarm.
    version : int or None
    received : str or None
        When the message came that led to it, under load long before.
    """

    text: str
    servo: str
    kind: str
    sentence: str
    time: str
    version: int | None = None
    received: str | None = None


def alarm_post(
    servo: str, kind: str, sentence: str, now: float, version: int | None = None, received: float | None = None
) -> AlarmPost:
    """Compose a post; `now` and `received`: s since the epoch."""
    words = sentence if sentence.startswith(kind) else f"{kind}: {sentence}"
    came = None if received is None else _utc(received)
    return AlarmPost(f"{servo}: {words}", servo, kind, sentence, _utc(now), version, came)


def _utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def send_post(config: WebhookConfig, post: AlarmPost) -> int:
    """Post once, and return the status; blocks. No proxy is used, and no redirect followed.

    Raises
    ------
    WebhookAway
        To be tried again.
    WebhookRefused
    """
    parts = urlsplit(config.url)
    host, path = parts.hostname or "", (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    headers: Mapping[str, str] = {"Content-Type": "application/json", "User-Agent": "servotwin"}
    if config.secret is not None:
        headers = {**headers, "Authorization": f"Bearer {config.secret}"}
    connection: HTTPConnection
    if is_encrypted(config.url):
        context = tls_context(config.ca_file)
        connection = HTTPSConnection(host, parts.port, timeout=_TIMEOUT_S, context=context)
    else:
        connection = HTTPConnection(host, parts.port, timeout=_TIMEOUT_S)
    with closing(connection):
        try:
            connection.request("POST", path, msgspec.json.encode(post), dict(headers))
            status = connection.getresponse().status
        except (OSError, HTTPException) as error:
            cause = cause_of(error, is_encrypted(config.url), config.ca_file)
            raise WebhookAway(f"{config.host}: {cause}") from None
    if status >= 500 or status in (408, 425, 429):
        raise WebhookAway(f"{config.host} answers with status {status}")
    if not 200 <= status < 300:
        raise WebhookRefused(f"{config.host} answers with status {status}")
    return status
