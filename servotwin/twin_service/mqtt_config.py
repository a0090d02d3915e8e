"""[service.mqtt]: the broker over which edges may reach the service as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from servotwin.config.table import Table, named
from servotwin.link.broker import Broker
from servotwin.link.url import is_here
from servotwin.twin_service.auth import read_secret

PASSWORD = "SERVOTWIN_MQTT_PASSWORD"
"""Environment variable with the password of the service's user at the broker."""
GROUP = "twins"


@dataclass(frozen=True)
class MqttConfig:
    """How the service takes part in a broker's traffic.

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
        """Whether the broker runs on this machine."""
        return is_here(self.broker.address[0])


def mqtt(table: Table, folder: Path, environment: Mapping[str, str]) -> MqttConfig:
    """[service.mqtt]; paths are relative to `folder`.

    Raises
    ------
    InvalidInput
        A value is not allowed, or a file that it names cannot be read, or is readable by others.
    """
    url, user = table.text("url"), table.text("user", None)
    file, ca_file = table.text("password_file", None), table.text("ca_file", None)
    group = table.text("group", GROUP)
    if not group or set(group) & set("/+#"):
        raise table.invalid("group", "a name without /, + and #")
    password = read_secret(folder / file) if file is not None else environment.get(PASSWORD)
    with named(table):
        return MqttConfig(Broker(url, user, password if user is not None else None, _path(folder, ca_file)), group)


def _path(folder: Path, name: str | None) -> str | None:
    return None if name is None else str(folder / name)
