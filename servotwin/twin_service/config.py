"""Configuration of the twin's service: address, store, TLS, tokens and limits."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from servotwin.config.files import readable, secret_file
from servotwin.config.keys import Form, check, key, settings
from servotwin.config.table import Table, read_inner
from servotwin.config.toml import attribute, read
from servotwin.errors import InvalidInput
from servotwin.link.broker import Broker
from servotwin.link.url import certificates, is_here
from servotwin.messages import MAX_BYTES
from servotwin.twin_service.webhook import WebhookConfig, webhook_table

PASSWORD = "SERVOTWIN_STORE_PASSWORD"
"""Environment variable with the password of the store."""
MQTT_PASSWORD = "SERVOTWIN_MQTT_PASSWORD"
"""Environment variable with the password of the service's user at the broker."""
SQLITE = "sqlite:///"
GROUP = "twins"
_LOG_LEVELS = ("debug", "info", "warning", "error")
_MOST = 1_000_000


@dataclass(frozen=True)
class MqttConfig:
    """Connection of the service to an MQTT broker.

    Attributes
    ----------
    broker : Broker
    group : str
        Twin processes of one group share the work.
    """

    broker: Broker
    group: str = GROUP

    @property
    def local(self) -> bool:
        """True where the broker runs on this machine."""
        return is_here(self.broker.address[0])


def _group(table: Table, name: str, group: str, _folder: Path) -> str:
    if not group or set(group) & set("/+#"):
        raise table.invalid(name, "a name without /, + and #")
    return group


def mqtt_table(
    environment: Mapping[str, str],
    url: Annotated[str, key(help="mqtt(s)://host[:port].")],
    user: Annotated[str | None, key(help="Name of the service at the broker.")] = None,
    password: Annotated[
        str | None,
        key(
            "password_file",
            form=Form.PATH,
            parse=secret_file,
            help=f"File of mode 0600 with its password; where absent the environment's {MQTT_PASSWORD}.",
        ),
    ] = None,
    ca_file: Annotated[
        str | None,
        key(
            relative=True,
            parse=certificates,
            help="Certificates that the broker's is checked against; the system's where absent.",
        ),
    ] = None,
    group: Annotated[str, key(parse=_group, help="Twin processes of one group share the work.")] = GROUP,
) -> MqttConfig:
    """Broker over which edges may reach the service as well."""
    password = environment.get(MQTT_PASSWORD) if password is None else password
    return MqttConfig(Broker(url, user, password if user is not None else None, ca_file), group)


def _address(table: Table, name: str, address: str, _folder: Path) -> str:
    try:
        return str(ipaddress.ip_address("127.0.0.1" if address == "localhost" else address))
    except ValueError:
        raise table.invalid(name, "an IP address of this machine, such as 127.0.0.1 or 0.0.0.0") from None


def _store_url(table: Table, name: str, url: str, _folder: Path) -> str:
    if "://" not in url:
        raise table.invalid(name, "a URL such as sqlite:///twin.db or postgresql://user@host/database")
    head = url.split("://", 1)[1].split("/", 1)[0]
    if ":" in head.rpartition("@")[0] or "password=" in url.partition("?")[2]:
        raise InvalidInput(
            f"{table.source}: {table.path(name)} holds a password; give it in store_password_file or in the "
            f"environment variable {PASSWORD}"
        )
    if not url.startswith(SQLITE):
        _check_address(table.source, table.path(name), url)
    return url


def _check_address(source: str, key: str, url: str) -> None:
    from servotwin.store.engine import parse_address  # what it imports takes long, and is not needed for SQLite

    try:
        parse_address(url)
    except InvalidInput as error:
        raise InvalidInput(f"{source}: {key}: {error}") from None


@settings("service")
@dataclass(frozen=True)
class ServiceConfig:
    """Settings of the service.

    Parameters
    ----------
    store_password : str or None
        Not shown.
    mqtt : MqttConfig or None
        A broker over which edges may reach the service as well.
    webhook : WebhookConfig or None
        An address to which alarms are posted.
    """

    bind: Annotated[
        str,
        key(
            parse=_address,
            help="IP address; any but the machine's own loopback requires tokens, and TLS or a proxy with TLS.",
        ),
    ] = "127.0.0.1"
    port: Annotated[int, key(minimum=0, maximum=65535, help="Port; 0: any free one.")] = 8765
    store: Annotated[
        str, key(parse=_store_url, help="SQLAlchemy URL without a password; a SQLite file is relative to this one.")
    ] = "sqlite:///twin.db"
    store_password: str | None = None
    store_ca: Annotated[
        Path | None,
        key(
            parse=certificates,
            help="PEM file with the certificates against which PostgreSQL's is checked, with its host's name "
            "(sslmode=verify-full); where absent, the connection is as the URL says.",
        ),
    ] = None
    workers: Annotated[int, key(minimum=1, maximum=256, help="Processes that estimate.")] = 2
    tls_certificate: Annotated[Path | None, key(parse=readable, help="PEM file; both or none.")] = None
    tls_key: Annotated[Path | None, key(parse=readable, help="PEM file with the certificate's key.")] = None
    behind_proxy: Annotated[bool, key(help="A proxy in front of the service does TLS; this requires tokens too.")] = (
        False
    )
    tokens: Annotated[
        Path | None,
        key(
            help="File with the verifiers of servos and operators; where absent, anyone who reaches the machine may do "
            "everything."
        ),
    ] = None
    lockstep: Annotated[bool, key(help="Requests give the time, and the service works only on request.")] = False
    verifications_per_minute: Annotated[
        float, key(minimum=0.0, help="Largest rate at which verifications are started.")
    ] = 6.0
    retention_days: Annotated[
        float,
        key(above=0.0, infinite=True, help="Time after which the body of a window that led to no update is deleted."),
    ] = 30.0
    rate_limit_per_s: Annotated[
        float, key(above=0.0, help="Largest mean rate of messages from one servo, and of its polls.")
    ] = 20.0
    rate_burst: Annotated[float, key(above=0.0, help="Largest burst of messages from one servo, and of its polls.")] = (
        200.0
    )
    max_body_bytes: Annotated[
        int, key(minimum=1024, maximum=MAX_BYTES, help="Largest size of a body, as sent and as decompressed.")
    ] = MAX_BYTES
    samples_per_window: Annotated[
        int,
        key(minimum=1, help="Largest number of samples of a window; a worker's time and memory for it grow with them."),
    ] = 250_000
    megabytes_per_day: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Largest mean rate at which one servo fills the disk, in MB of messages as they are stored; of a rate "
            "above it the edge keeps the excess, and sends it later.",
        ),
    ] = 10_000.0
    unauthenticated_connections: Annotated[
        int,
        key(
            minimum=1,
            maximum=_MOST,
            help="Largest number of connections open at once that have shown no token and no dashboard's session.",
        ),
    ] = 8192
    unauthenticated_per_address: Annotated[
        int,
        key(
            minimum=1,
            maximum=_MOST,
            help="Largest number of them from one address, once they are older than 2 s; with tokens only, and not "
            "behind a proxy.",
        ),
    ] = 128
    body_timeout_s: Annotated[float, key(above=0.0, help="Time within which a body must arrive.")] = 30.0
    long_polls: Annotated[int, key(minimum=1, maximum=_MOST, help="Largest number of long polls open at once.")] = (
        20_000
    )
    polls_per_servo: Annotated[
        int, key(minimum=1, maximum=_MOST, help="Largest number of long polls of one servo open at once.")
    ] = 8
    connections_per_servo: Annotated[
        int,
        key(
            minimum=4,
            maximum=_MOST,
            help="Largest number of connections with one servo's token open at once; a further one closes the oldest. "
            "Not behind a proxy.",
        ),
    ] = 64
    watchers: Annotated[
        int, key(minimum=0, maximum=_MOST, help="Largest number of dashboards that watch the fleet at once.")
    ] = 100
    machine_metrics: Annotated[
        bool,
        key(
            help="Serve gap, interval, wear, version and link of each machine for Prometheus at /metrics/machines, to "
            "operators' tokens only."
        ),
    ] = False
    queue: Annotated[
        int, key(minimum=1, maximum=_MOST, help="Largest number of messages that wait for their commit.")
    ] = 2000
    speed: Annotated[float, key(above=0.0, help="Largest ratio of sample time to real time.")] = 1.0
    future_slack_s: Annotated[
        float, key(minimum=0.0, help="Largest lead of a window's sample time over that ratio.")
    ] = 60.0
    job_timeout_s: Annotated[float, key(above=0.0, help="Time for one servo after which a worker is replaced.")] = 300.0
    worker_megabytes: Annotated[
        float,
        key(
            minimum=500.0,
            infinite=True,
            help="Memory of its own that a worker may have, in MB; a message that needs more fails, and is counted.",
        ),
    ] = 2000.0
    worker_share: Annotated[
        float,
        key(
            above=0.0,
            maximum=1.0,
            help="Largest share of one worker's time for one servo, while work waits for a worker.",
        ),
    ] = 0.5
    lag_limit_s: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Time for which new messages of a servo may wait for their turn; beyond it the service reports itself "
            "as degraded.",
        ),
    ] = 30.0
    log_level: Annotated[str, key(choices=_LOG_LEVELS, help="Level of the log.")] = "info"
    mqtt: MqttConfig | None = None
    webhook: WebhookConfig | None = None

    def __post_init__(self) -> None:
        check(self)
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise InvalidInput("tls_certificate and tls_key belong together: give both or none")
        if self.store_ca is not None and not self.store.startswith("postgresql"):
            raise InvalidInput(f"store_ca is for PostgreSQL; store is {self.store!r}")
        if self.store_ca is not None and "ssl" in self.store.partition("?")[2]:
            raise InvalidInput(
                "store_ca and options ssl... of the store's URL exclude each other; leave the latter out"
            )
        if not self.local and (self.tokens is None or (self.tls_key is None and not self.behind_proxy)):
            raise InvalidInput(
                f"bind = {self.bind!r} can be reached from other machines: this requires tokens, and tls_certificate "
                "with tls_key or, where a proxy does TLS, behind_proxy = true"
            )
        if self.behind_proxy and self.tokens is None:
            raise InvalidInput("behind_proxy = true lets other machines reach the service: this requires tokens")
        if self.mqtt is not None and not self.mqtt.local and self.tokens is None:
            raise InvalidInput(f"mqtt url = {self.mqtt.broker.url!r} is not on this machine: this requires tokens")
        if self.mqtt is not None and self.lockstep:
            raise InvalidInput("lockstep = true and mqtt exclude each other: lock-step works over HTTP only")

    def __repr__(self) -> str:
        return f"ServiceConfig(bind={self.bind!r}, port={self.port!r}, store={self.store!r})"

    @property
    def local(self) -> bool:
        """True where only this machine reaches the service."""
        return is_here(self.bind)

    @property
    def encrypted(self) -> bool:
        """True where browsers reach the service over TLS."""
        return self.tls_key is not None or self.behind_proxy


def read_service(table: Table, folder: Path, environment: Mapping[str, str] = os.environ) -> ServiceConfig:
    """Read the table [service]; paths are relative to `folder`.

    Raises
    ------
    InvalidInput
        A key is unknown, a value is not allowed, or a file that it names cannot be read or is readable by others.
    """
    mqtt = None
    if "mqtt" in table.values:
        mqtt = read_inner(table, "mqtt", lambda inner: read(inner, mqtt_table, folder, environment=environment))
    table.known("mqtt")
    webhook = None
    if "webhook" in table.values:
        webhook = read_inner(table, "webhook", lambda inner: read(inner, webhook_table, folder))
    table.known("webhook")
    store = _sqlite_in(attribute(table, ServiceConfig, "store", folder), folder)
    password = read(table, store_password_table, folder)
    service: ServiceConfig = read(
        table,
        ServiceConfig,
        folder,
        store=store,
        store_password=environment.get(PASSWORD) if password is None else password,
        mqtt=mqtt,
        webhook=webhook,
    )
    return service


def store_password_table(
    password: Annotated[
        str | None,
        key(
            "store_password_file",
            form=Form.PATH,
            parse=secret_file,
            help="File of mode 0600 with the store's password.",
        ),
    ] = None,
) -> str | None:
    """Return the store's password, where a file holds it."""
    return password


def _sqlite_in(url: str, folder: Path) -> str:
    """Return the URL of a store, a relative path of SQLite resolved against `folder`."""
    path = url.removeprefix(SQLITE)
    return url if path == url or not path else f"{SQLITE}{(folder / path).absolute()}"
