"""What systemd is told, and that nothing of it can stop a service."""

import os
import socket
from contextlib import suppress
from pathlib import Path

import pytest
from notify_socket import listening

from servotwin.runtime.service_manager import ServiceManager


def test_a_service_says_that_it_is_ready_that_it_lives_and_that_it_ends() -> None:
    with listening() as heard:
        manager = ServiceManager({"NOTIFY_SOCKET": str(heard.path), "WATCHDOG_USEC": "2000000"})
        manager.ready()
        for tenth in range(25):  # 2.5 s, in which a sign of life is due every second
            manager.alive(100.0 + tenth / 10.0)
        manager.stopping()
        assert heard.received() == ["READY=1", "WATCHDOG=1", "WATCHDOG=1", "WATCHDOG=1", "STOPPING=1"]


@pytest.mark.parametrize("environment", [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"}])
def test_no_sign_of_life_where_none_is_asked_of_this_process(environment: dict[str, str]) -> None:
    with listening() as heard:
        manager = ServiceManager({"NOTIFY_SOCKET": str(heard.path), **environment})
        manager.alive(0.0)
        manager.stopping()
        assert heard.received() == ["STOPPING=1"]


def test_an_abstract_socket_is_reached() -> None:
    name = f"servotwin-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(f"\0{name}")
        manager = ServiceManager({"NOTIFY_SOCKET": f"@{name}"})
        manager.ready()
        assert end.recv(100) == b"READY=1"
        manager.stopping()


def test_what_a_service_manager_with_a_full_queue_did_not_take_is_said_at_the_next_turn() -> None:
    with listening() as heard:
        manager = ServiceManager({"NOTIFY_SOCKET": str(heard.path), "WATCHDOG_USEC": "2000000"})
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as others:
            others.setblocking(False)
            with suppress(BlockingIOError):  # its queue is full
                while True:
                    others.sendto(b"of others", str(heard.path))
        manager.ready()
        manager.alive(100.0)
        assert set(heard.received()) == {"of others"}
        heard.states.clear()
        for tenth in range(1, 5):  # the next sign of life would be due at 101 s
            manager.alive(100.0 + tenth / 10.0)
        assert heard.received() == ["READY=1", "WATCHDOG=1"]
        manager.stopping()


def test_a_service_that_nothing_watches_says_again_that_it_is_ready() -> None:
    """Its service manager was starting anew at the first time."""
    with listening() as heard:
        away = heard.path.rename(heard.path.with_name("away"))
        manager = ServiceManager({"NOTIFY_SOCKET": str(heard.path)})
        manager.ready()
        away.rename(heard.path)
        manager.alive(0.0)
        manager.alive(1.0)
        assert heard.received() == ["READY=1"]
        manager.stopping()


def test_a_full_or_missing_socket_stops_nothing(tmp_path: Path) -> None:
    for environment in ({"NOTIFY_SOCKET": str(tmp_path / "nobody")}, {}):
        manager = ServiceManager(environment)
        manager.ready()
        manager.stopping()
    with listening() as heard:
        manager = ServiceManager({"NOTIFY_SOCKET": str(heard.path)})
        for _ in range(5000):  # nobody reads: its queue is full after some
            manager.ready()
        assert 0 < len(heard.received()) < 5000
        manager.stopping()
