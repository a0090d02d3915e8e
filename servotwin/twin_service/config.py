"""What a twin's file says of the service itself: its address, its store, who may speak to it, and how much."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from servotwin.config.table import Reader, Table, given, named, part
from servotwin.errors import InvalidInput
from servotwin.link.url import is_here
from servotwin.messages import MAX_BYTES
from servotwin.twin_service.auth import read_secret
from servotwin.twin_service.mqtt_config import MqttConfig, mqtt

PASSWORD = "SERVOTWIN_STORE_PASSWORD"
"""Environment variable with the password of the store."""
SQLITE = "sqlite:///"
LOG_LEVELS = ("debug", "info", "warning", "error")


@dataclass(frozen=True)
class ServiceConfig:
    """How the service runs.

    Attributes
    ----------
    bind : str
        IP address; anything but the machine itself asks for tokens and for TLS or a proxy that does it.
    port : int
        0: any free one.
    store : str
        SQLAlchemy URL without a password.
    store_password : str or None
        Not shown.
    workers : int
        Processes that estimate.
    tls_certificate, tls_key : Path or None
        PEM files; both or none.
    behind_proxy : bool
        A proxy on the way does TLS; that asks for tokens too.
    tokens : Path or None
        Verifiers of servos and operators; None: whoever reaches the machine itself may do everything.
    lockstep : bool
        Time is what requests say it is; nothing is done but on request.
    proofs_per_minute : float
        How many proofs are begun at most.
    retention_days : float
        How long windows are kept that led to no update.
    rate_limit_per_s, rate_burst : float
        Messages of one servo, on average and at once.
    max_body_bytes : int
        Of a body, as sent and as decompressed.
    body_timeout_s : float
        A body has to be there by then.
    long_polls : int
        Open at once.
    queue : int
        Messages that wait for their commit.
    speed : float
        Sample time passes at most so many times as fast as time.
    future_slack_s : float
        s of sample time that a window may lie ahead of that.
    job_timeout_s : float
        A worker that takes longer over one servo is replaced.
    log_level : str
    mqtt : MqttConfig or None
        A broker over which edges may reach the service as well.
    """

    bind: str = "127.0.0.1"
    port: int = 8765
    store: str = "sqlite:///twin.db"
    store_password: str | None = None
    workers: int = 2
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    behind_proxy: bool = False
    tokens: Path | None = None
    lockstep: bool = False
    proofs_per_minute: float = 6.0
    retention_days: float = 30.0
    rate_limit_per_s: float = 20.0
    rate_burst: float = 200.0
    max_body_bytes: int = MAX_BYTES
    body_timeout_s: float = 30.0
    long_polls: int = 20_000
    queue: int = 2000
    speed: float = 1.0
    future_slack_s: float = 60.0
    job_timeout_s: float = 300.0
    log_level: str = "info"
    mqtt: MqttConfig | None = None

    def __post_init__(self) -> None:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise InvalidInput("tls_certificate and tls_key belong together: give both or none")
        if not self.local and (self.tokens is None or (self.tls_key is None and not self.behind_proxy)):
            raise InvalidInput(
                f"bind = {self.bind!r} can be reached from other machines: that is allowed only with tokens, and with "
                "tls_certificate and tls_key or, where a proxy does the TLS, behind_proxy = true"
            )
        if self.behind_proxy and self.tokens is None:
            raise InvalidInput("behind_proxy = true lets other machines reach the service: that asks for tokens")
        if self.mqtt is not None and not self.mqtt.local and self.tokens is None:
            raise InvalidInput(f"mqtt url = {self.mqtt.broker.url!r} is not on this machine: that asks for tokens")
        if self.mqtt is not None and self.lockstep:
            raise InvalidInput("lockstep = true and mqtt exclude each other: in lock-step edges ask over HTTP")

    def __repr__(self) -> str:
        return f"ServiceConfig(bind={self.bind!r}, port={self.port!r}, store={self.store!r})"

    @property
    def local(self) -> bool:
        """Whether only this machine reaches the service."""
        return is_here(self.bind)


def _address(table: Table, key: str) -> str:
    address = table.text(key)
    try:
        return str(ipaddress.ip_address("127.0.0.1" if address == "localhost" else address))
    except ValueError:
        raise table.invalid(key, "an IP address of this machine, such as 127.0.0.1 or 0.0.0.0") from None


def _positive(table: Table, key: str) -> float:
    return table.number(key, positive=True)


def _not_negative(table: Table, key: str) -> float:
    return table.number(key, minimum=0.0)


def _count(table: Table, key: str) -> int:
    return table.integer(key, minimum=1, maximum=1_000_000)


def _days(table: Table, key: str) -> float:
    return table.number(key, positive=True, infinite=True)


PLAIN: Mapping[str, Reader] = {
    "bind": ("bind", _address),
    "port": ("port", lambda table, key: table.integer(key, minimum=0, maximum=65535)),
    "workers": ("workers", lambda table, key: table.integer(key, minimum=1, maximum=256)),
    "behind_proxy": ("behind_proxy", Table.boolean),
    "lockstep": ("lockstep", Table.boolean),
    "proofs_per_minute": ("proofs_per_minute", _not_negative),
    "retention_days": ("retention_days", _days),
    "rate_limit_per_s": ("rate_limit_per_s", _positive),
    "rate_burst": ("rate_burst", _positive),
    "max_body_bytes": (
        "max_body_bytes",
        lambda table, key: table.integer(key, minimum=1024, maximum=MAX_BYTES),
    ),
    "body_timeout_s": ("body_timeout_s", _positive),
    "long_polls": ("long_polls", _count),
    "queue": ("queue", _count),
    "speed": ("speed", _positive),
    "future_slack_s": ("future_slack_s", _not_negative),
    "job_timeout_s": ("job_timeout_s", _positive),
    "log_level": ("log_level", lambda table, key: table.text(key, choices=LOG_LEVELS)),
}


def service(table: Table, folder: Path, environment: Mapping[str, str] = os.environ) -> ServiceConfig:
    """[service]; paths are relative to `folder`.

    Raises
    ------
    InvalidInput
        A key is unknown, a value is not allowed, a file that it names cannot be read, or is readable by others.
    """
    paths = given(table, {key: (key, partial(_file, folder)) for key in ("tls_certificate", "tls_key")})
    paths |= given(table, {"tokens": ("tokens", lambda table, key: folder / table.text(key))})
    values = {**given(table, PLAIN), **paths, **_store(table, folder, environment)}
    if "mqtt" in table.values:
        values["mqtt"] = part(table, "mqtt", lambda inner: mqtt(inner, folder, environment))
    table.known("mqtt")
    with named(table):
        return ServiceConfig(**values)


def _file(folder: Path, table: Table, key: str) -> Path:
    path = folder / table.text(key)
    if not path.is_file():
        raise table.invalid(key, f"the path of a file, relative to {folder}")
    return path


def _store(table: Table, folder: Path, environment: Mapping[str, str]) -> dict[str, str | None]:
    """URL and password of the store; a relative path of SQLite lies in `folder`."""
    url = table.text("store", ServiceConfig.store)
    file = table.text("store_password_file", None)
    if "://" not in url:
        raise table.invalid("store", "a URL such as sqlite:///twin.db or postgresql+psycopg://user@host/database")
    head = url.split("://", 1)[1].split("/", 1)[0]
    if ":" in head.rpartition("@")[0] or "password=" in url.partition("?")[2]:
        raise InvalidInput(
            f"{table.source}: {table.path('store')} holds a password; give it in store_password_file or in the "
            f"environment variable {PASSWORD}"
        )
    password = environment.get(PASSWORD) if file is None else read_secret(folder / file)
    return {"store": sqlite_in(url, folder), "store_password": password}


def sqlite_in(url: str, folder: Path) -> str:
    """The URL, a relative path of SQLite taken from `folder`."""
    path = url.removeprefix(SQLITE)
    return url if path == url or not path else f"{SQLITE}{(folder / path).absolute()}"
