"""Connections without a valid token or session are bounded, in all and per address; others are not."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from service_system import OPERATOR, OTHER, TOKEN, served, twin_file

from servotwin.twin_service import http_edge, unauthenticated
from servotwin.twin_service.http_server import HttpServer
from servotwin.twin_service.listening import listening_socket

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]
Connect = Callable[..., Awaitable[Stream]]
PATIENCE = 30.0
SESSION = "session"
"""In place of a token: the cookie of an operator's session."""


def serving(folder: Path, service: str, body: Callable[[Connect], Awaitable[None]]) -> None:
    """Run a coroutine function against a service behind a socket; it gets a function that connects with a token."""

    async def run() -> None:
        async with served(twin_file(folder, service)) as (system, _):
            listener = listening_socket(system.config)
            server = HttpServer(
                system.config, system.http_app(), system.polls.close, system.unauthenticated, lambda: True
            )
            server.config.lifespan = "off"
            task = asyncio.create_task(server.serve([listener]))
            opened: list[asyncio.StreamWriter] = []

            async def connect(token: str, source: str = "127.0.0.1") -> Stream:
                reader, writer = await asyncio.open_connection(*listener.getsockname()[:2], local_addr=(source, 0))
                opened.append(writer)
                head = f"Authorization: Bearer {token}\r\n" if token else ""
                if token.endswith(SESSION):
                    cookie = system.operators.session_cookie(OPERATOR.encode()).partition(";")[0]
                    # A forged one has another code at its end.
                    head = f"Cookie: a=b; {cookie if token == SESSION else cookie[:-64] + 64 * '0'}\r\n"
                writer.write(f"GET /v1/servos/ax-1/outgoing HTTP/1.1\r\nHost: twin\r\n{head}\r\n".encode())
                return reader, writer

            try:
                await body(connect)
            finally:
                for writer in opened:
                    writer.close()
                server.should_exit = True
                await task

    asyncio.run(run())


async def answer(reader: asyncio.StreamReader) -> bytes:
    """First line of an answer; empty where the connection was closed."""
    try:
        async with asyncio.timeout(PATIENCE):
            return await reader.readline()
    except ConnectionError:
        return b""


async def is_closed(reader: asyncio.StreamReader) -> bool:
    try:
        async with asyncio.timeout(PATIENCE):
            while await reader.read(4096):
                pass
    except (TimeoutError, ConnectionError) as error:
        return isinstance(error, ConnectionError)
    return True


def test_connections_of_an_address_without_a_token_are_bounded_and_edges_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unauthenticated, "_GRACE_S", 0.05)
    monkeypatch.setattr(http_edge, "REFUSED_POLL_S", 0.0)  # shorter than the grace, as it is

    async def body(connect: Connect) -> None:
        edges = [await connect(TOKEN) for _ in range(8)]
        assert [b"200" in await answer(reader) for reader, _ in edges] == [True] * 8
        foreign = [await connect(token) for token in ("", "wrong", "", "wrong", "")]
        for reader, _ in foreign:
            assert b"401" in await answer(reader)
        # The first two to be checked go, in whatever order; three are allowed.
        ends = [asyncio.create_task(is_closed(reader)) for reader, _ in foreign]
        async with asyncio.timeout(PATIENCE):
            while sum(each.done() for each in ends) < 2:
                await asyncio.sleep(0.01)
        assert [each.result() for each in ends if each.done()] == [True, True]
        for reader, writer in edges:
            assert not writer.is_closing()
            assert not reader.at_eof()
        for each in ends:
            each.cancel()

    serving(tmp_path, "unauthenticated_per_address = 3", body)


def test_a_session_counts_as_authenticated_and_a_forged_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unauthenticated, "_GRACE_S", 0.05)
    monkeypatch.setattr(http_edge, "REFUSED_POLL_S", 0.0)  # shorter than the grace, as it is

    async def body(connect: Connect) -> None:
        known, forged = await connect(SESSION), [await connect(f"forged {SESSION}") for _ in range(2)]
        # A session reads the fleet, not an edge's messages.
        assert [b"401" in await answer(reader) for reader, _ in (known, *forged)] == [True] * 3
        assert await is_closed(forged[0][0])
        for reader, writer in (known, forged[1]):
            assert not writer.is_closing()
            assert not reader.at_eof()

    serving(tmp_path, "unauthenticated_per_address = 1", body)


@pytest.mark.slow
def test_connections_without_a_token_are_bounded_in_all_and_one_address_has_half_of_the_places(tmp_path: Path) -> None:
    async def body(connect: Connect) -> None:
        first, second = await connect(""), await connect("")
        assert b"401" in await answer(first[0])
        assert b"401" in await answer(second[0])
        assert await answer((await connect(TOKEN))[0]) == b""
        assert b"200" in await answer((await connect(TOKEN, "127.0.0.2"))[0])
        others = [await connect("", source) for source in ("127.0.0.2", "127.0.0.3")]
        for reader, _ in others:
            assert b"401" in await answer(reader)
        assert await answer((await connect(TOKEN, "127.0.0.4"))[0]) == b""
        first[1].close()
        await first[1].wait_closed()
        async with asyncio.timeout(PATIENCE):
            while b"200" not in await answer((await connect(TOKEN))[0]):
                await asyncio.sleep(0.01)
        for _ in range(5):  # who has shown a token counts no more
            assert b"200" in await answer((await connect(TOKEN))[0])

    serving(tmp_path, "unauthenticated_connections = 4", body)


def test_without_tokens_and_behind_a_proxy_no_connection_is_limited(tmp_path: Path) -> None:
    async def limit(service: str, tokens: bool) -> object:
        async with served(twin_file(tmp_path, service, tokens)) as (system, _):
            return system.unauthenticated

    assert asyncio.run(limit("", False)) is None
    assert asyncio.run(limit("behind_proxy = true", True)) is None
    assert asyncio.run(limit("", True)) is not None


@pytest.mark.slow
def test_a_servos_token_holds_a_bounded_number_of_connections_and_the_newest_live(tmp_path: Path) -> None:
    async def body(connect: Connect) -> None:
        held = [await connect(TOKEN) for _ in range(4)]
        other, operator = await connect(OTHER), [await connect(OPERATOR) for _ in range(5)]
        for reader, _ in (*held, other, *operator):
            assert await answer(reader)
        newer = [await connect(TOKEN) for _ in range(2)]
        for reader, _ in newer:
            assert b"200" in await answer(reader)
        assert [await is_closed(reader) for reader, _ in held[:2]] == [True, True]
        for reader, _ in (*held[2:], *newer, other, *operator):
            assert not reader.at_eof()
        # One that has ended makes room.
        held[2][1].close()
        await asyncio.sleep(0.2)
        assert b"200" in await answer((await connect(TOKEN))[0])
        assert not held[3][0].at_eof()

    serving(tmp_path, "connections_per_servo = 4", body)
