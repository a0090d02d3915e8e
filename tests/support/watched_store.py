"""Helpers of tests that watch a twin's store: windows sent to a served twin, and what it asks for."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

from service_system import bearer, place, served, window

from servotwin.messages import Resend, decode, encode


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(30.0):
        while not true():
            await asyncio.sleep(0.02)


Body = Callable[..., Awaitable[None]]


def serve(path: Path, body: Body) -> None:
    async def both() -> None:
        async with served(path) as (system, client):
            await body(system, client)

    asyncio.run(both())


async def send(client, *sequences: int) -> list[int]:
    sent = [window(n) for n in sequences]
    answers = [await client.put(place(one), content=encode(one), headers=bearer()) for one in sent]
    return [answer.status_code for answer in answers]


def posted(system) -> list[Resend]:
    return [decode(each.body) for each in system.store.outgoing("ax-1", 0)]
