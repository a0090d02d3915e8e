"""A service in this process for the tests of this folder."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import httpx
import pytest
from service_system import served, twin_file

from servotwin.twin_service import http_edge, refusals
from servotwin.twin_service.service import TwinService

Body = Callable[[TwinService, httpx.AsyncClient], Coroutine[Any, Any, None]]


@pytest.fixture(scope="module")
def no_pause_for_refused():
    """Refused requests are answered at once, where a test is not about who is held back for how long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refusals, "_SLOW_S", 0.0)
        patch.setattr(http_edge, "REFUSED_POLL_S", 0.0)
        yield


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
