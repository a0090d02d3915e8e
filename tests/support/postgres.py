"""A PostgreSQL server for tests: a cluster of its own in a temporary folder, reached by a socket in that folder."""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import psycopg
from mosquitto import free_port
from servers import needed

PATIENCE_S = 60.0
OPTIONS = {"listen_addresses": "", "fsync": "off", "full_page_writes": "off", "max_connections": "100"}


class Server(NamedTuple):
    """A running server: where its socket lies, and whose databases they are."""

    folder: Path
    user: str
    port: int = 5432

    def database(self, name: str, language: str = "") -> str:
        """A new, empty database; its URL. With a `language` (of ICU) it sorts as people there do."""
        sorts = f" TEMPLATE template0 LOCALE_PROVIDER icu ICU_LOCALE '{language}'" if language else ""
        with psycopg.connect(self._parameters("postgres"), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"{sorts}')
        return f"postgresql://{self.user}@/{name}?host={self.folder}"

    def run(self, name: str, statement: str) -> None:
        """Run a statement in a database."""
        with self.connect(name) as connection:
            connection.execute(statement)

    def connect(self, name: str) -> psycopg.Connection[tuple[Any, ...]]:
        """Connect to a database."""
        return psycopg.connect(self._parameters(name), autocommit=True)

    def answers(self) -> bool:
        """True where it accepts connections."""
        try:
            psycopg.connect(self._parameters("postgres")).close()
        except psycopg.OperationalError:
            return False
        return True

    def _parameters(self, name: str) -> str:
        return f"host={self.folder} port={self.port} user={self.user} dbname={name}"


@contextlib.contextmanager
def running(certificate: tuple[Path, Path] | None = None) -> Iterator[Server]:
    """A server, until the block ends. It refuses to run as root, who therefore starts it as user postgres.

    With a `certificate` and its key it also listens at 127.0.0.1, over TLS.
    """
    initdb = needed("initdb")
    user = "postgres" if os.geteuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    process = None
    try:
        if user:
            shutil.chown(folder, user, user)
        # Without its own name in the environment, libpq would read a home that is not the server's.
        started = {"user": user, "group": user, "extra_groups": []} if user else {}
        server = Server(folder, "postgres")
        silent = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
            "cwd": folder,
        }
        make = [initdb, "--no-sync", "--auth=trust", "--username=postgres", "--encoding=UTF8", "--locale=C"]
        subprocess.run([*make, folder / "data"], check=True, timeout=PATIENCE_S, **silent, **started)
        options = dict(OPTIONS)
        if certificate is not None:
            options |= _tls(certificate, folder, user)
            server = server._replace(port=int(options["port"]))
        settings = [word for name, value in options.items() for word in ("-c", f"{name}={value}")]
        command = [initdb.with_name("postgres"), "-D", folder / "data", "-k", folder, *settings]
        process = subprocess.Popen(command, start_new_session=True, **silent, **started)
        _wait(server, process)
        yield server
    finally:
        if process is not None:
            _end(process)
        shutil.rmtree(folder)


def _tls(certificate: tuple[Path, Path], folder: Path, user: str | None) -> dict[str, str]:
    """Options with which a server does TLS; it demands that its key is its own user's, and private."""
    copies = [Path(shutil.copy(file, folder)) for file in certificate]
    for file in copies:
        file.chmod(0o600)
        if user:
            shutil.chown(file, user, user)
    names = {"ssl": "on", "ssl_cert_file": str(copies[0]), "ssl_key_file": str(copies[1])}
    return {"listen_addresses": "127.0.0.1", "port": str(free_port()), **names}


def _wait(server: Server, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not server.answers():
        assert process.poll() is None, "the PostgreSQL server ended"
        assert time.monotonic() < end, "the PostgreSQL server does not answer"
        time.sleep(0.05)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)  # "fast": connections are cut
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
