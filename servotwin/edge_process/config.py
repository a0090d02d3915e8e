"""What `edge.toml` says: one servo's edge as a process."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from pathlib import Path
from urllib.parse import urlsplit

from servotwin.config.table import Table
from servotwin.control.controller import Controller
from servotwin.control.law import LawParameters
from servotwin.edge.settings import AgentSettings
from servotwin.errors import InvalidInput
from servotwin.link.broker import is_mqtt
from servotwin.link.url import in_clear

ROLES = ("control", "supervise")
UNBOOTED = "unbooted"
"""The boot's name in a configuration: each start takes its own."""
MB = 1_000_000


@dataclass(frozen=True, slots=True)
class TwinLink:
    """Where the twin is, and how it is spoken to.

    Parameters
    ----------
    url : str
        https://host[:port][/path], http:// on this machine itself, or a broker's: mqtt(s)://host[:port].
    token_file, token_env : str, optional
        Where the servo's token is: a file of mode 0600, or an environment variable; one of them.
    ca_file : str, optional
        Certificates that the twin's, or the broker's, is checked against; None: the system's.
    timeout_s : float
        For an answer, s.
    wait_s : float
        How long one poll waits for something new, s.
    user : str, optional
        Of the edge at the broker.
    password_file, password_env : str, optional
        Where the user's password is, as the token is given.
    """

    url: str
    token_file: str | None = None
    token_env: str | None = None
    ca_file: str | None = None
    timeout_s: float = 10.0
    wait_s: float = 25.0
    user: str | None = None
    password_file: str | None = None
    password_env: str | None = None

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
        if not 0.0 < self.timeout_s < inf:
            raise InvalidInput(f"timeout_s = {self.timeout_s!r} s: must be finite and greater than 0")
        if not 0.0 <= self.wait_s <= 30.0:
            raise InvalidInput(f"wait_s = {self.wait_s!r} s: must be 0 to 30")

    @property
    def over_mqtt(self) -> bool:
        """Whether the twin is reached over a broker."""
        return is_mqtt(self.url)


@dataclass(frozen=True, slots=True)
class Keeping:
    """What is kept on disk; paths are relative to the configuration's folder.

    Parameters
    ----------
    outbox, parameters, status, boots : str
        Windows and letters not taken yet; the parameters that were proved last; what `servotwin edge` shows; how often
        this edge was started.
    windows, bytes : int
        The outbox holds no more.
    """

    outbox: str = "outbox.sqlite"
    parameters: str = "parameters.json"
    status: str = "status.json"
    boots: str = "boots"
    windows: int = 5000
    bytes: int = 256 * MB

    def __post_init__(self) -> None:
        if self.windows < 1:
            raise InvalidInput(f"outbox windows = {self.windows!r}: must be at least 1")
        if self.bytes < MB:
            raise InvalidInput(f"outbox megabytes = {self.bytes / MB!r}: must be at least 1")


@dataclass(frozen=True, slots=True)
class SensorGuard:
    """What happens when a sample is not finite.

    Parameters
    ----------
    hold_s : float
        The last voltage is held this long, s; then the safe one is given until the samples are good again.
    safe_voltage : float
        V.
    """

    hold_s: float = 0.01
    safe_voltage: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.hold_s < inf:
            raise InvalidInput(f"hold_s = {self.hold_s!r} s: must be finite and at least 0")
        if not isfinite(self.safe_voltage):
            raise InvalidInput(f"safe_voltage_v = {self.safe_voltage!r} V: must be finite")


@dataclass(frozen=True, slots=True)
class EdgeConfig:
    """One servo's edge.

    Parameters
    ----------
    agent : AgentSettings
        Of a boot without name; its `controller` is set where updates may set gains.
    role : str
        "control": the edge ticks the law; "supervise": the drive has a controller of its own.
    controller : Controller, optional
        As configured; needed to control, and where updates may set gains. Its rate is the samples'.
    drive : mapping of str to TOML value
        What the drive's kind ("kind") reads.
    twin : TwinLink, optional
        None: it runs without a twin, and keeps its windows.
    keeping : Keeping
    sensor : SensorGuard
    priority : int
        Of the control process among real-time ones (SCHED_FIFO), 1 to 99; 0: it is none.
    folder : path
        What paths are relative to.
    source : str
        The file's name in messages.
    """

    agent: AgentSettings
    role: str
    controller: Controller | None
    drive: Mapping[str, object]
    twin: TwinLink | None = None
    keeping: Keeping = field(default_factory=Keeping)
    sensor: SensorGuard = field(default_factory=SensorGuard)
    priority: int = 0
    folder: Path = field(default=Path(), compare=False)
    source: str = field(default="edge.toml", compare=False)

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise InvalidInput(f"role = {self.role!r} is not allowed; give one of {', '.join(ROLES)}")
        if self.controller is None and (self.role == "control" or self.agent.controller is not None):
            raise InvalidInput("table [controller] is missing: it is needed to control, and where updates set gains")
        if self.agent.controller is not None and self.agent.controller != self.controller:
            raise InvalidInput("the agent's controller is not the one that runs")
        if self.role == "control" and self.law_rate != self.agent.sample_rate:
            allowed = f"must be that of the samples, {self.agent.sample_rate!r} Hz"
            raise InvalidInput(f"controller sample_rate_hz = {self.law_rate!r} Hz: {allowed}")
        if not 0 <= self.priority <= 99:
            raise InvalidInput(f"realtime_priority = {self.priority!r}: must be 0 to 99")
        if "kind" not in self.drive:
            raise InvalidInput("key 'drive.kind' is missing")

    @property
    def law_rate(self) -> float | None:
        """Of the controller, Hz."""
        return None if self.controller is None else self.controller.sample_rate

    @property
    def drive_table(self) -> Table:
        """For the drive's own reader."""
        return Table(self.source, self.drive, "drive")

    def path(self, name: str) -> Path:
        """Where a file of the configuration is."""
        return self.folder / name

    def settings(self, boot: str) -> AgentSettings:
        """The agent's, for one boot."""
        return replace(self.agent, boot=boot)

    def law(self, controller: Controller | None, tolerance: float) -> LawParameters:
        """The law for a controller (None: as configured) and a tolerance (m)."""
        chosen = controller or self.controller
        assert chosen is not None, "the role is to control"
        return chosen.law(tolerance)


def token_of(twin: TwinLink, folder: Path, environment: Mapping[str, str] = os.environ) -> str:
    """The servo's token.

    Raises
    ------
    InvalidInput
        There is none, or others may read its file; the token itself is never shown.
    """
    return _secret("token", twin.token_file, twin.token_env, folder, environment)


def password_of(twin: TwinLink, folder: Path, environment: Mapping[str, str] = os.environ) -> str | None:
    """The password of the edge's user at the broker, None where there is no user; raises InvalidInput as `token_of`."""
    if twin.user is None:
        return None
    return _secret("password", twin.password_file, twin.password_env, folder, environment)


def _is_http(url: str) -> bool:
    try:
        parts = urlsplit(url)
        good = parts.scheme in ("http", "https") and parts.hostname and not (parts.query or parts.fragment)
        return bool(good) and parts.username is None and (parts.port is None or parts.port > 0)
    except ValueError:
        return False


def _secret(what: str, file: str | None, variable: str | None, folder: Path, environment: Mapping[str, str]) -> str:
    """From a private file or the environment."""
    if variable is not None:
        return _checked(what, environment.get(variable, "").strip(), f"environment variable {variable}")
    assert file is not None
    path = folder / file
    try:
        if path.stat().st_mode & 0o077:
            raise InvalidInput(f"{path}: others than its owner may open it; give it mode 0600")
        return _checked(what, path.read_text(encoding="utf-8").strip(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path}: the {what} cannot be read ({getattr(error, 'strerror', None) or error})") from None


def _checked(what: str, secret: str, where: str) -> str:
    if not secret or not secret.isascii() or not secret.isprintable() or " " in secret:
        raise InvalidInput(f"{where}: holds no {what}; printable characters without spaces are allowed")
    return secret
