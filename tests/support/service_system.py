"""A twin's service in this process, or as one of its own, for tests."""

import asyncio
import contextlib
import os
import signal
import ssl
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from random import Random

import httpx
import msgspec

from servotwin import messages
from servotwin.link.seal import verifier_of
from servotwin.messages import Hello, Setting, WindowMessage, encode, pack_channel
from servotwin.store.store import open_store
from servotwin.twin_service.auth import Verifiers, write_tokens
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool

TOKEN, OTHER, OPERATOR, ENGINEER = "token-of-ax-1", "token-of-ax-2", "token-of-the-operator", "token-of-the-engineer"
SERVO = '[models.axis]\nservo = "paper"\n[models.axis.twin]\npolicy = "paper"\n[servos]\n"ax-*" = "axis"\n'
MSGPACK = {"content-type": "application/msgpack"}


def twin_file(folder: Path, service: str = "", tokens: bool = True, servos: str = SERVO) -> Path:
    """A twin's file in a folder, and its tokens."""
    path = folder / "twin.toml"
    if tokens:
        edges = {"ax-1": verifier_of(TOKEN), "ax-2": verifier_of(OTHER)}
        people = {"me": verifier_of(OPERATOR)}, {"eva": verifier_of(ENGINEER)}
        write_tokens(folder / "tokens.toml", Verifiers(edges, *people))
        service = f'tokens = "tokens.toml"\n{service}'
    path.write_text(f"[service]\nport = 0\nworkers = 1\n{service}\n{servos}")
    return path


def window(
    sequence: int = 0, servo: str = "ax-1", boot: str = "b", start: float | None = None, samples: int = 200
) -> WindowMessage:
    """A window of noise."""
    random = Random(sequence)
    names = (("position", "m"), ("theta_m", "rad"))
    channels = tuple(pack_channel(name, unit, [random.gauss(0, 1) for _ in range(samples)]) for name, unit in names)
    begin = float(sequence) if start is None else start
    crc = messages.checksum(channels)
    return WindowMessage(servo, boot, sequence, begin, 1000.0, channels, (), 0, "model", "test", crc)


def hello(servo: str = "ax-1", boot: str = "b", time: float = 0.0) -> bytes:
    """An edge's first word."""
    return encode(Hello(servo, boot, time, 1000.0, 0, Setting(0.0), "model"))


def bearer(token: str = TOKEN) -> dict[str, str]:
    """The header with a token."""
    return {"authorization": f"Bearer {token}"}


def place(result: WindowMessage) -> str:
    """Path of a window."""
    return f"/v1/servos/{result.servo}/windows/{result.boot}/{result.sequence}"


@contextlib.asynccontextmanager
async def served(path: Path, workers: int = 0) -> AsyncIterator[tuple[TwinService, httpx.AsyncClient]]:
    """The service in this process, its lifespan begun, and a client of it."""
    twin = read_twin(path)
    store = open_store(twin.service.store)
    pool = WorkerPool(workers, twin.start, twin.service.job_timeout_s)
    system = TwinService(twin, store, pool=pool)
    app = system.http_app()
    try:
        async with app.lifespan():
            transport = httpx.ASGITransport(app, raise_app_exceptions=True)
            async with httpx.AsyncClient(transport=transport, base_url="http://twin") as client:
                yield system, client
    finally:
        store.close()


@contextlib.contextmanager
def process(path: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The service as a process, and its URL; whatever is left of its group is killed in the end."""
    command = [sys.executable, "-m", "servotwin", "twin", "--config", str(path), *options]
    log = (path.parent / "log").open("a")
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True)
    try:
        assert running.stdout is not None
        line = running.stdout.readline()
        assert "listening on" in line, f"{line!r}: {(path.parent / 'log').read_text()[-2000:]}"
        yield running, line.split()[-1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.communicate(timeout=30)
        log.close()


def trusting(certificate: Path) -> ssl.SSLContext:
    """Trusts one certificate."""
    return ssl.create_default_context(cafile=str(certificate))


def unpacked(body: bytes) -> object:
    """Decoded MessagePack."""
    return msgspec.msgpack.decode(body)


def with_service(folder, body, service=""):
    """Run `body(system, client)` while a twin of a new file in `folder` is served."""

    async def run():
        async with served(twin_file(folder, service)) as (system, client):
            await body(system, client)

    asyncio.run(run())
