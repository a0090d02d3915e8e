"""Requests to a service without workers in this process."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import httpx
import pytest
from service_system import MSGPACK, TOKEN, bearer, place, served, twin_file

from servotwin.messages import encode
from servotwin.twin_service.service import TwinService

Body = Callable[[TwinService, httpx.AsyncClient], Coroutine[Any, Any, None]]


@pytest.fixture
def serving(tmp_path):
    """Runs a coroutine function against a service that has no workers."""

    def run(body: Body, service: str = "", tokens: bool = True) -> None:
        async def both() -> None:
            async with served(twin_file(tmp_path, service, tokens)) as (system, client):
                await body(system, client)

        asyncio.run(both())

    run.folder = tmp_path
    return run


async def put(client: httpx.AsyncClient, sent, token=TOKEN, to=None, **headers) -> httpx.Response:
    body = sent if isinstance(sent, bytes) else encode(sent)
    named = {**bearer(token), **MSGPACK, **{key.replace("_", "-"): value for key, value in headers.items()}}
    return await client.put(to or place(sent), content=body, headers=named)


def code(answer: httpx.Response) -> tuple[int, str]:
    content = answer.json()
    assert set(content) == {"code", "detail"}
    assert content["detail"].strip()
    return answer.status_code, content["code"]
