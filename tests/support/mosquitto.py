"""A mosquitto of its own for a test: a free port of this machine, its own settings; it can be killed and started."""

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from getpass import getuser
from pathlib import Path
from typing import NamedTuple

from servers import needed


class Login(NamedTuple):
    """Who may connect."""

    user: str
    password: str


class Tls(NamedTuple):
    """PEM files."""

    certificate: Path
    key: Path


class Mosquitto:
    """A broker in a folder."""

    def __init__(
        self,
        folder: Path,
        logins: tuple[Login, ...] = (),
        tls: Tls | None = None,
        rules: str = "",
        settings: tuple[str, ...] = (),
    ) -> None:
        self.program, self.folder, self.port = needed("mosquitto"), folder, free_port()
        self.scheme = "mqtt" if tls is None else "mqtts"
        self.process: subprocess.Popen[bytes] | None = None
        lines = [
            f"listener {self.port} 127.0.0.1",
            f"user {getuser()}",
            f"allow_anonymous {'false' if logins else 'true'}",
            "set_tcp_nodelay true",
            "max_inflight_messages 1000",
            "max_queued_messages 100000",
            *settings,
        ]
        if logins:
            lines.append(f"password_file {self._passwords(logins)}")
        if rules:
            (folder / "acl").write_text(rules)
            (folder / "acl").chmod(0o600)
            lines.append(f"acl_file {folder / 'acl'}")
        if tls is not None:
            lines += [f"certfile {tls.certificate}", f"keyfile {tls.key}"]
        self._settings = folder / "mosquitto.conf"
        self._settings.write_text("\n".join(lines) + "\n")

    @property
    def url(self) -> str:
        return f"{self.scheme}://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Start it and wait until it listens."""
        with (self.folder / "mosquitto.log").open("ab") as log:
            command = [str(self.program), "-c", str(self._settings)]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        for _ in range(1000):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1.0):
                return
            assert self.process.poll() is None, (self.folder / "mosquitto.log").read_text()
            time.sleep(0.01)
        raise AssertionError("mosquitto does not listen")

    def kill(self) -> None:
        """SIGKILL: it forgets everything."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def _passwords(self, logins: tuple[Login, ...]) -> Path:
        path = self.folder / "passwords"
        path.touch(mode=0o600)
        tool = self.program.with_name("mosquitto_passwd")
        tool = tool if tool.exists() else Path("/usr/bin/mosquitto_passwd")
        for login in logins:
            subprocess.run([tool, "-b", path, *login], check=True, capture_output=True)
        return path


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@contextmanager
def broker(
    folder: Path,
    logins: tuple[Login, ...] = (),
    tls: Tls | None = None,
    rules: str = "",
    settings: tuple[str, ...] = (),
) -> Iterator[Mosquitto]:
    """One that runs; `rules` say who may do what, `settings` are further lines of its file."""
    folder.mkdir(exist_ok=True)
    made = Mosquitto(folder, logins, tls, rules, settings)
    made.start()
    try:
        yield made
    finally:
        made.kill()
