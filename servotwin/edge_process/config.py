"""Configuration of one servo's edge as a process, from `edge.toml`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from servotwin.config.files import read_secret, secret_in
from servotwin.config.keys import check, key, settings
from servotwin.config.own_units import COMMANDS, POSITIONS, OwnUnits
from servotwin.config.table import Table, of_key
from servotwin.config.toml import values_of
from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.running_law import RunningLaw
from servotwin.edge.settings import AgentSettings
from servotwin.errors import InvalidInput
from servotwin.link.broker import is_mqtt
from servotwin.link.seal import MAX_TOKEN
from servotwin.link.url import in_clear, is_encrypted, system_certificates, tls_context

ROLES = ("control", "supervise")
UNBOOTED = "unbooted"
"""Placeholder for the boot's name in a configuration: each start has its own."""
MB = 1_000_000


@settings("twin")
@dataclass(frozen=True, slots=True)
class TwinLink:
    """Address of the twin, and the secrets for it."""

    url: Annotated[
        str,
        key(
            help="https://host[:port][/path], http:// on this machine itself, or a broker's: mqtt(s)://host[:port].",
        ),
    ]
    token_file: Annotated[
        str | None, key(help="File of mode 0600 with the servo's token; either this or token_env.")
    ] = None
    token_env: Annotated[str | None, key(help="Environment variable with the servo's token.")] = None
    ca_file: Annotated[
        str | None,
        key(help="Certificates against which the twin's or the broker's is checked; the system's where absent."),
    ] = None
    timeout_s: Annotated[float, key(above=0.0, help="Longest wait for an answer.")] = 10.0
    wait_s: Annotated[float, key(minimum=0.0, maximum=30.0, help="Longest time that one poll waits for a message.")] = (
        25.0
    )
    user: Annotated[str | None, key(help="Name of the edge at the broker.")] = None
    password_file: Annotated[
        str | None, key(help="File of mode 0600 with the user's password; either this or password_env.")
    ] = None
    password_env: Annotated[str | None, key(help="Environment variable with the user's password.")] = None
    live: Annotated[
        bool,
        key(
            help="While somebody watches the machine on the twin's dashboard, send the least and greatest position, "
            "error and voltage of each 100 ms.",
            later=True,
        ),
    ] = False

    def __post_init__(self) -> None:
        if not (self.over_mqtt or _is_http(self.url)):
            allowed = "http(s)://host[:port][/path] or mqtt(s)://host[:port]"
            raise InvalidInput(f"url = {self.url!r} is not allowed; give {allowed}")
        if in_clear(self.url):
            raise InvalidInput(f"url = {self.url!r} would send the token in clear to another machine; give https://")
        if not self.over_mqtt and self.user is not None:
            raise InvalidInput(f"user = {self.user!r} is for a broker, mqtt(s)://host[:port]; url is {self.url!r}")
        if (self.password_file, self.password_env).count(None) != (2 if self.user is None else 1):
            raise InvalidInput("user and one of password_file and password_env belong together")
        if (self.token_file is None) == (self.token_env is None):
            raise InvalidInput("token_file or token_env is needed, and only one of them")
        check(self)

    @property
    def over_mqtt(self) -> bool:
        """True if the twin is reached over a broker."""
        return is_mqtt(self.url)


@settings("keep")
@dataclass(frozen=True, slots=True)
class StoredFiles:
    """Files that the edge writes; paths are relative to the configuration's folder."""

    outbox: Annotated[str, key(help="Outbox: messages that the twin has not acknowledged.")] = "outbox.sqlite"
    parameters: Annotated[str, key(help="Last parameters under which the loop kept its band.")] = "parameters.json"
    status: Annotated[str, key(help="Status that `servotwin edge` shows.")] = "status.json"
    boots: Annotated[str, key(help="Number of starts of this edge that had an outbox on the disk.")] = "boots"
    metrics: Annotated[
        str | None,
        key(
            help="Metrics in Prometheus' text format, for node_exporter's textfile collector: a name that ends with "
            ".prom, in the collector's folder; none where absent.",
            later=True,
        ),
    ] = None
    windows: Annotated[int, key(minimum=1, help="Largest number of windows in the outbox.")] = 5000
    bytes: Annotated[int, key("megabytes", minimum=MB, help="Largest size of the outbox.")] = 256 * MB
    acknowledged_bytes: Annotated[
        int,
        key(
            "acknowledged_megabytes",
            minimum=0,
            help="Largest size of the acknowledged windows that stay, for a twin that was restored from a backup and "
            "asks for them; 0: none.",
            later=True,
        ),
    ] = 128 * MB
    acknowledged_s: Annotated[
        float,
        key(
            minimum=0.0,
            help="Time of running for which they stay; it should reach back to the twin's last backup.",
            later=True,
        ),
    ] = 172_800.0

    def __post_init__(self) -> None:
        check(self)
        if self.metrics is not None and not self.metrics.endswith(".prom"):
            raise InvalidInput(f"metrics = {self.metrics!r}: the name must end with .prom; others are not collected")


@settings("sensor")
@dataclass(frozen=True, slots=True)
class SensorGuard:
    """Voltage while samples are not finite."""

    hold_s: Annotated[
        float,
        key(minimum=0.0, help="Time for which the last voltage is held; then the safe one until samples are good."),
    ] = 0.01
    safe_voltage: Annotated[float, key("safe_voltage_v", help="Safe voltage.")] = 0.0

    def __post_init__(self) -> None:
        check(self)


@settings("edge")
@dataclass(frozen=True, slots=True)
class EdgeConfig:
    """One servo's edge.

    Parameters
    ----------
    agent : AgentSettings
        Settings for a boot without name; its `controller` is set where updates may set gains.
    controller : Controller, Cascade or LinearLaw, optional
        Configured controller; required in the role control, and where updates may set gains. Its rate is that of the
        samples.
    drive : mapping of str to TOML value
        Keys for the drive of the kind that the key `kind` names.
    folder : path
        Folder that paths are relative to.
    source : str
        The file's name in messages.
    """

    agent: AgentSettings
    role: Annotated[
        str,
        key(choices=ROLES, help="control: the edge ticks the law; supervise: the drive has a controller of its own."),
    ]
    controller: AnyController | None
    drive: Mapping[str, object]
    twin: Annotated[
        TwinLink | None, key(help="Address of the twin; where absent the edge runs without one and stores its windows.")
    ] = None
    files: Annotated[StoredFiles, key("keep", help="Files that the edge writes.")] = field(default_factory=StoredFiles)
    sensor: Annotated[SensorGuard, key(help="Voltage while samples are not finite.")] = field(
        default_factory=SensorGuard
    )
    priority: Annotated[
        int,
        key(
            "realtime_priority",
            minimum=0,
            maximum=99,
            help="Real-time priority of the control process (SCHED_FIFO); 0: normal scheduling.",
        ),
    ] = 0
    command_unit: Annotated[
        str,
        key(
            choices=tuple(COMMANDS),
            help="Unit of the drive's command, in which the keys of this file count it.",
            later=True,
        ),
    ] = "V"
    position_unit: Annotated[
        str,
        key(
            choices=tuple(POSITIONS),
            help="Unit of the position, in which the keys of this file count it; with rad a key may count degrees.",
            later=True,
        ),
    ] = "m"
    folder: Path = field(default=Path(), compare=False)
    source: str = field(default="edge.toml", compare=False)

    def __post_init__(self) -> None:
        check(self)
        if self.controller is None and (self.role == "control" or self.agent.controller is not None):
            raise InvalidInput("table [controller] is missing: role = 'control' and update_gains = true need it")
        if self.agent.controller is not None and self.agent.controller != self.controller:
            raise InvalidInput("the controller of agent must be the one that runs")
        if self.role == "control" and self.law_rate != self.agent.sample_rate:
            allowed = f"must be that of the samples, {self.agent.sample_rate!r} Hz"
            raise InvalidInput(f"controller sample_rate_hz = {self.law_rate!r} Hz: {allowed}")
        law = None if self.controller is None else law_of(self.controller)
        if not self.agent.motor_encoder and isinstance(law, LinearLaw) and law.reads("y_motor"):
            raise InvalidInput(
                "motor_encoder = false: the controller reads y_motor, the motor's encoder; give one that reads the "
                "load only, or motor_encoder = true"
            )
        if "kind" not in self.drive:
            raise InvalidInput("key 'drive.kind' is missing")

    @property
    def units(self) -> OwnUnits:
        """Units of the file's keys, and of the status."""
        return OwnUnits(self.command_unit, self.position_unit)

    @property
    def law_rate(self) -> float | None:
        """Sample rate of the controller, Hz."""
        return None if self.controller is None else self.controller.sample_rate

    @property
    def drive_table(self) -> Table:
        """Table [drive], which the drive's own reader parses."""
        return Table(self.source, self.drive, "drive", self.units)

    @property
    def link_table(self) -> Table:
        """Table [twin], to name its keys in errors."""
        return Table(self.source, {} if self.twin is None else values_of(self.twin), "twin")

    def path(self, name: str) -> Path:
        """Path of a file that the configuration names."""
        return self.folder / name

    def settings(self, boot: str) -> AgentSettings:
        """Settings of the agent for one boot."""
        return replace(self.agent, boot=boot)

    def law(self, controller: AnyController | None, tolerance: float) -> RunningLaw:
        """Discretise a controller (None: the configured one) with a tolerance (m)."""
        chosen = controller or self.controller
        assert chosen is not None, "the role control needs a controller"
        return RunningLaw(chosen, tolerance)


def token_of(config: EdgeConfig, environment: Mapping[str, str] = os.environ) -> str:
    """Read the servo's token; empty where there is no twin.

    Raises
    ------
    InvalidInput
        It is missing or too long, or others may read its file; the message names file and key, never the token.
    """
    if config.twin is None:
        return ""
    return _secret(config, config.twin.token_file, "token", environment, in_header=True, longest=MAX_TOKEN)


def password_of(config: EdgeConfig, environment: Mapping[str, str] = os.environ) -> str | None:
    """Read the password of the edge's user at the broker; None without a user. Raises InvalidInput as `token_of`."""
    if config.twin is None or config.twin.user is None:
        return None
    return _secret(config, config.twin.password_file, "password", environment, in_header=False)


def check_certificates(config: EdgeConfig) -> None:
    """Check the certificates against which the twin's is checked, where the link is encrypted; raises InvalidInput."""
    twin = config.twin
    if twin is not None and twin.ca_file is not None and is_encrypted(twin.url):
        with of_key(config.link_table, "ca_file"):
            tls_context(str(config.path(twin.ca_file)))


def certificates_of(config: EdgeConfig) -> bytes:
    """Read the certificates against which the twin's is checked; empty: the link is not encrypted, or there are none.

    Raises
    ------
    InvalidInput
        The file cannot be read, or holds none.
    """
    twin = config.twin
    if twin is None or not is_encrypted(twin.url):
        return b""
    check_certificates(config)
    path = system_certificates() if twin.ca_file is None else config.path(twin.ca_file)
    try:
        return b"" if path is None else path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None


def _secret(
    config: EdgeConfig,
    file: str | None,
    name: str,
    environment: Mapping[str, str],
    *,
    in_header: bool,
    longest: float = math.inf,
) -> str:
    """Read a secret from the file `NAME_file` of [twin], or from the environment variable `NAME_env`."""
    table = config.link_table
    if file is not None:
        with of_key(table, f"{name}_file"):
            return read_secret(config.path(file), in_header=in_header, longest=longest)
    with of_key(table, f"{name}_env"):
        variable = str(table.values[f"{name}_env"])
        return secret_in(environment, variable, in_header=in_header, longest=longest)


def _is_http(url: str) -> bool:
    try:
        parts = urlsplit(url)
        good = parts.scheme in ("http", "https") and parts.hostname and not (parts.query or parts.fragment)
        return bool(good) and parts.username is None and (parts.port is None or parts.port > 0)
    except ValueError:
        return False
