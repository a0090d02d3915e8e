"""Refused requests that come in a loop are slowed down, whoever sends them, and others are not."""

import asyncio
import time
from pathlib import Path

import httpx
import pytest
from service_system import MSGPACK, OPERATOR, OTHER, TOKEN, bearer, hello, place, served, twin_file, window

from servotwin.messages import encode
from servotwin.twin_service import limits, refusals

SLOW, CLIENTS, LASTS = 0.3, 5, 0.9
MOST = 100 + round(10 * LASTS) + CLIENTS * (round(LASTS / SLOW) + 1)
"""Refusals that are answered at once, and those of clients that each wait for the one before."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path", "token"),
    [
        ("PUT", "/v1/servos/ax-1/windows/b/1", "wrong"),
        ("PUT", "/v1/servos/ax-1/windows/b/1", TOKEN),  # no window: refused by its content, then by its rate
        ("POST", "/v1/servos/ax-1/letters", ""),
        ("POST", "/v1/servos/ax-1/claim", OTHER),
        ("DELETE", "/v1/servos/ax-1", TOKEN),
        ("GET", "/nothing", ""),
        ("GET", "/v1/servos", "wrong"),
    ],
)
def test_whoever_repeats_a_refused_request_is_slowed_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, path: str, token: str
) -> None:
    monkeypatch.setattr(refusals, "_SLOW_S", SLOW)

    async def repeat(client: httpx.AsyncClient, end: float) -> int:
        answers = 0
        while time.monotonic() < end:
            answer = await client.request(method, path, content=b"no message", headers=bearer(token) if token else {})
            assert 400 <= answer.status_code < 500
            answers += 1
        return answers

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            end = time.monotonic() + LASTS
            loops = [asyncio.create_task(repeat(client, end)) for _ in range(CLIENTS)]
            await asyncio.sleep(0.5 * LASTS)
            begun = time.monotonic()
            assert (await client.get("/v1/servos", headers=bearer(OPERATOR))).status_code == 200
            letter = await client.post(
                "/v1/servos/ax-2/letters", content=hello("ax-2"), headers={**MSGPACK, **bearer(OTHER)}
            )
            assert letter.status_code == 202
            assert time.monotonic() - begun < SLOW, "what is not refused is not slowed"
            answers = sum(await asyncio.gather(*loops))
            assert answers <= MOST
            assert system.metrics.rejected.values.total() == answers

    asyncio.run(body())


@pytest.mark.slow
def test_beside_a_flood_another_sender_waits_for_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strangers and the edge come from one address; what tells them apart is the edge's token."""
    monkeypatch.setattr(refusals, "_SLOW_S", SLOW)

    async def flood(client: httpx.AsyncClient, end: float) -> int:
        answers = 0
        while time.monotonic() < end:
            answer = await client.put("/v1/servos/ax-1/windows/b/1", content=b"", headers=bearer("wrong"))
            assert answer.status_code == 401
            answers += 1
        return answers

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (_, client):
            end = time.monotonic() + LASTS
            loops = [asyncio.create_task(flood(client, end)) for _ in range(CLIENTS)]
            await asyncio.sleep(0.6 * LASTS)
            for path, token in (("/v1/servos/ax-1/windows/b/1", TOKEN), ("/v1/servos/ax-2/letters", OTHER)):
                begun = time.monotonic()
                answer = await client.request(
                    "PUT" if "windows" in path else "POST", path, content=b"no message", headers=bearer(token)
                )
                assert answer.status_code == 400
                assert time.monotonic() - begun < SLOW
            assert sum(await asyncio.gather(*loops)) <= MOST

    asyncio.run(body())


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    found: list[float] = []

    async def sleep(seconds: float) -> None:
        found.append(seconds)

    monkeypatch.setattr(refusals.asyncio, "sleep", sleep)
    return found


def test_a_few_refusals_take_no_time_again_after_a_while(waits: list[float]) -> None:
    now = [0.0]
    counted = refusals.Refusals(refusals.Metrics(), monotonic=lambda: now[0])

    def count(number: int, sender: str = "a") -> int:
        waits.clear()
        for _ in range(number):
            asyncio.run(counted.hold_back(sender))
        return len(waits)

    assert count(150) == 50
    assert count(100, "b") == 0
    now[0] += 1.0
    assert count(15) == 5


def test_senders_in_memory_are_a_fixed_number(waits: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MAX_SERVOS", 10)
    counted = refusals.Refusals(refusals.Metrics(), monotonic=lambda: 0.0)

    async def flood() -> None:
        for _ in range(101):
            await counted.hold_back("first")
        for number in range(1000):
            await counted.hold_back(f"another {number}")
        assert len(counted._pace._levels) == 10
        await counted.hold_back("first")  # it left long ago

    asyncio.run(flood())
    assert len(waits) == 1


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("192.0.2.1", "192.0.2.2", False),
        ("192.0.2.1", "::ffff:192.0.2.1", True),
        ("2001:db8::1", "2001:db8::ffff:1", True),  # of one site, whose computers choose the rest of it
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::1", True),
        ("", "testclient", False),
    ],
)
def test_a_sender_without_a_valid_token_is_its_address(one: str, other: str, same: bool) -> None:
    known = refusals.Refusals(refusals.Metrics(), owner_of=lambda token: "ax-1" if token == b"right" else "")
    assert (known.sender(None, one) == known.sender(b"wrong", other)) is same
    assert known.sender(b"right", one) == known.sender(b"right", other) != known.sender(None, one)


def test_a_window_at_another_window_s_address_is_not_judged(tmp_path: Path) -> None:
    """The answer has no mark of the body, without which the edge keeps the window: a proxy changed the address."""

    async def body() -> None:
        async with served(twin_file(tmp_path)) as (_system, client):
            answer = await client.put(place(window(1)), content=encode(window(0)), headers=bearer())
            assert answer.status_code == 400
            assert answer.json() == {
                "code": "other_name",
                "detail": "the window is b/0, not what the address says",
            }

    asyncio.run(body())
