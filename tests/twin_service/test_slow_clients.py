"""Clients that never finish: handshakes, heads and bodies are bounded in time, and handshakes in number."""

import asyncio
import socket
import ssl
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

import pytest
from selfsigned import self_made
from service_system import TOKEN, bearer, served, twin_file

from servotwin.twin_service import http_server, tls_handshakes
from servotwin.twin_service.http_server import HttpServer
from servotwin.twin_service.listening import listening_socket

PATIENCE = 30.0
PUT = b"PUT /v1/servos/ax-1/windows/b/0 HTTP/1.1\r\nHost: t\r\nAuthorization: Bearer " + TOKEN.encode()
Body = Callable[[HttpServer, tuple[str, int]], Awaitable[None]]


def serving(folder: Path, service: str, body: Body) -> None:
    """Run a coroutine function against a service behind a socket."""

    async def run() -> None:
        async with served(twin_file(folder, service)) as (system, _):
            listener = listening_socket(system.config)
            server = HttpServer(
                system.config, system.http_app(), system.polls.close, system.unauthenticated, lambda: True
            )
            server.config.lifespan = "off"
            task = asyncio.create_task(server.serve([listener]))
            try:
                await body(server, listener.getsockname()[:2])
            finally:
                server.should_exit = True
                await task

    asyncio.run(run())


async def rest(reader: asyncio.StreamReader) -> bytes:
    """All that comes until the other end closes."""
    found = b""
    with suppress(ConnectionError):  # it was reset while more was on its way to it
        async with asyncio.timeout(PATIENCE):
            while part := await reader.read(4096):
                found += part
    return found


async def dripped(address: tuple[str, int], begin: bytes, drop: bytes) -> bytes:
    """Send a beginning at once, and then a few bytes again and again; what comes until the other end closes."""
    reader, writer = await asyncio.open_connection(*address)
    writer.write(begin)
    answer = asyncio.create_task(rest(reader))
    while not answer.done():
        writer.write(drop)
        await asyncio.wait([answer], timeout=0.02)
    writer.close()
    return answer.result()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("begin", "drop"),
    [
        (b"", b""),
        (b"GET /", b"a"),
        (b"GET /healthz HTTP/1.1\r\n", b"a"),
        (b"GET /healthz HTTP/1.1\r\n", b"a: b\r\n"),
        (b"GET /healthz HTTP/1.1\r\n\r\nGET /he", b"a"),
    ],
    ids=["nothing", "path", "header", "headers", "second request"],
)
def test_a_head_that_comes_byte_by_byte_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begin: bytes, drop: bytes
) -> None:
    monkeypatch.setattr(http_server, "_HEAD_S", 0.3)

    async def body(_server: HttpServer, address: tuple[str, int]) -> None:
        answer = await dripped(address, begin, drop)
        assert answer.count(b"HTTP/1.1 ") == begin.count(b"\r\n\r\n")

    serving(tmp_path, "", body)


@pytest.mark.slow
@pytest.mark.parametrize("length", [b"Content-Length: 100000", b"Transfer-Encoding: chunked"])
def test_a_body_that_comes_byte_by_byte_is_refused_for_now_and_its_connection_closed(
    tmp_path: Path, length: bytes
) -> None:
    async def body(_server: HttpServer, address: tuple[str, int]) -> None:
        drop = b"1\r\na\r\n" if b"chunked" in length else b"a"
        answer = await dripped(address, PUT + b"\r\n" + length + b"\r\n\r\n", drop)
        assert answer.startswith(b"HTTP/1.1 503")
        assert b"did not come within 0.3 s" in answer

    serving(tmp_path, "body_timeout_s = 0.3", body)


def tls(folder: Path) -> tuple[str, ssl.SSLContext]:
    certificate, _ = self_made(folder)
    return f'tls_certificate = "{certificate.name}"\ntls_key = "made.key"', ssl.create_default_context(
        cafile=str(certificate)
    )


async def health(address: tuple[str, int], trusted: ssl.SSLContext, source: str = "127.0.0.1") -> bytes:
    """First line of an answer over TLS; empty where the connection was closed."""
    try:
        reader, writer = await asyncio.open_connection(*address, ssl=trusted, local_addr=(source, 0))
    except (ConnectionError, ssl.SSLError):
        return b""
    writer.write(b"GET /healthz HTTP/1.1\r\nHost: t\r\n" + f"Authorization: {bearer()}\r\n\r\n".encode())
    line = await reader.readline()
    writer.close()
    return line


@pytest.mark.slow
def test_a_handshake_that_never_finishes_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_handshakes, "_HANDSHAKE_S", 0.3)
    service, trusted = tls(tmp_path)

    async def body(server: HttpServer, address: tuple[str, int]) -> None:
        hello = b"\x16\x03\x01\x02\x00\x01"  # the first bytes of a ClientHello
        for begin in (b"", hello, b"GET / HTTP/1.1\r\n\r\n"):
            reader, writer = await asyncio.open_connection(*address)
            writer.write(begin)
            assert b"HTTP" not in await rest(reader)
            writer.close()
        assert b" 503 " in await health(address, trusted)  # no workers here
        assert server.handshakes == 0

    serving(tmp_path, service, body)


def window_at_once(address: tuple[str, int], trusted: ssl.SSLContext, size: int) -> bytes:
    """First line of the answer to a body that is sent with the end of the handshake."""
    with (
        socket.create_connection(address, PATIENCE) as plain,
        trusted.wrap_socket(plain, server_hostname=address[0]) as line,
    ):
        line.sendall(PUT + f"\r\nContent-Length: {size}\r\n\r\n".encode() + b"x" * size)
        return line.recv(4096).partition(b"\r\n")[0]


@pytest.mark.slow
@pytest.mark.parametrize("size", [1000, 300_000, 2_000_000])
def test_a_window_right_after_the_handshake_arrives_whatever_its_size(tmp_path: Path, size: int) -> None:
    service, trusted = tls(tmp_path)

    async def busy() -> None:
        while True:
            time.sleep(0.05)  # so that the end of the handshake and the window are read together
            await asyncio.sleep(0.0)

    async def body(_server: HttpServer, address: tuple[str, int]) -> None:
        other = asyncio.create_task(busy())
        assert b" 400 " in await asyncio.to_thread(window_at_once, address, trusted, size)
        other.cancel()

    serving(tmp_path, service, body)


def test_handshakes_in_progress_are_bounded_and_leave_room_for_other_addresses(tmp_path: Path) -> None:
    service, trusted = tls(tmp_path)

    async def body(server: HttpServer, address: tuple[str, int]) -> None:
        lines = [await asyncio.open_connection(*address) for _ in range(6)]
        closed = [asyncio.create_task(rest(reader)) for reader, _ in lines]
        async with asyncio.timeout(PATIENCE):
            await asyncio.gather(*closed[4:])
        assert (server.handshakes, [task.done() for task in closed]) == (4, [False] * 4 + [True] * 2)
        assert await health(address, trusted) == b""
        assert b" 503 " in await health(address, trusted, "127.0.0.2")
        lines[0][1].close()
        async with asyncio.timeout(PATIENCE):
            while not await health(address, trusted):
                await asyncio.sleep(0.01)
        for _, writer in lines:
            writer.close()
        await asyncio.gather(*closed)

    serving(tmp_path, f"{service}\nunauthenticated_connections = 8", body)
