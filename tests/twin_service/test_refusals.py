"""Refused requests that come in a loop are slowed down, whoever sends them, and others are not."""

import asyncio
import time
from pathlib import Path

import httpx
import pytest
from service_system import MSGPACK, OPERATOR, OTHER, TOKEN, bearer, hello, served, twin_file

from servotwin.twin_service import refusals

SLOW, CLIENTS, LASTS = 0.3, 5, 1.5
MOST = 100 + round(10 * LASTS) + CLIENTS * (round(LASTS / SLOW) + 1)
"""Refusals that are answered at once, and those of clients that each wait for the one before."""


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


def test_a_few_refusals_take_no_time_again_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        waits.append(seconds)

    monkeypatch.setattr(refusals.asyncio, "sleep", sleep)
    now = [0.0]
    counted = refusals.Refusals(refusals.Metrics(), monotonic=lambda: now[0])

    def count(number: int) -> int:
        waits.clear()
        for _ in range(number):
            asyncio.run(counted.count(refusals.Refusal.BAD_TOKEN))
        return len(waits)

    assert count(150) == 50
    now[0] += 1.0
    assert count(15) == 5
    now[0] += 10.0
    assert count(100) == 0
