"""A broker and a store for tests over MQTT, and a twin for tests over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from faketwin import FakeTwin
from mosquitto import Mosquitto, broker

from servotwin.link.http import HttpTransport
from servotwin.store.store import Store, open_store


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Mosquitto]:
    with broker(tmp_path / "broker") as running:
        yield running


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = open_store(f"sqlite:///{tmp_path}/twin.db")
    yield store
    store.close()


@pytest.fixture
def twin() -> Iterator[FakeTwin]:
    with FakeTwin() as twin:
        yield twin


@pytest.fixture
def link(twin: FakeTwin) -> Iterator[HttpTransport]:
    transport = HttpTransport(twin.url, "axis-1", "secret", timeout_s=5.0, wait_s=0.2)
    yield transport
    transport.close()
