"""The crowd of `servotwin bench endurance`: servos in one process against a real twin over HTTP."""

import asyncio
import json
from pathlib import Path

import msgspec
import pytest
from service_system import OTHER, TOKEN, served, twin_file, window

from benchmarks.endurance_crowd import ACKNOWLEDGED, STATUS, STOP, Crowd, CrowdPlan, CrowdServo
from servotwin.link.seal import Sealed
from servotwin.messages import Receipt, Setting, Update, decode, encode
from servotwin.twin_service.http_server import HttpServer
from servotwin.twin_service.listening import listening_socket


@pytest.mark.slow
def test_a_crowd_sends_every_window_until_it_is_acknowledged_and_notes_that(tmp_path: Path) -> None:
    """Two servos, and a token that the twin refuses; the twin is away for a while."""

    async def run() -> set[tuple[str, int]]:
        async with served(twin_file(tmp_path, "speed = 1e6")) as (system, _):
            listener = listening_socket(system.config)
            port = listener.getsockname()[1]
            tokens = {"ax-1": TOKEN, "ax-2": OTHER, "ax-3": "unknown"}
            plan = CrowdPlan(port, tokens, 0.1, 2, tuple(encode(window(n)) for n in range(2)))
            crowd = asyncio.create_task(Crowd(plan, tmp_path, "c-1").run())
            await asyncio.sleep(0.2)
            server = HttpServer(
                system.config, system.http_app(), system.polls.close, system.unauthenticated, lambda: True
            )
            server.config.lifespan = "off"
            serving = asyncio.create_task(server.serve([listener]))
            async with asyncio.timeout(60.0):
                while len(stored(system)) < 6:
                    await asyncio.sleep(0.02)
                (tmp_path / STOP).touch()
                await crowd
            server.should_exit = True
            await serving
            return stored(system)

    def stored(system) -> set[tuple[str, int]]:
        links = {servo: system.store.audit(servo, limit=1000) for servo in ("ax-1", "ax-2")}
        return {(servo, link.window.sequence) for servo, found in links.items() for link in found}

    found = asyncio.run(run())
    lines = (tmp_path / ACKNOWLEDGED).read_text().splitlines()
    assert {(line.split()[0], int(line.split()[2])) for line in lines} == found
    assert all(line.split()[1] == "c-1" for line in lines)
    status = json.loads((tmp_path / STATUS).read_text())
    assert (status["waiting"], set(status["refused"])) == (0, {"401"})


def test_a_window_is_sent_again_with_the_same_bytes_and_updates_are_answered() -> None:
    servo = CrowdServo("ax-7", "secret", "c-1", 0.0, (window(0), window(1)))
    servo.cut(0.25, 0.1)
    assert [cut.start for cut in servo.waiting] == pytest.approx([0.0, 0.1, 0.2])
    first = servo.window(servo.waiting[1])
    update = Update("ax-7", 4, 3, ("b", 0), 0.0, None, None, (None, None), "ok", Setting(0.0), 100.0)
    sealed = msgspec.msgpack.encode(Sealed("ax-7", 9, encode(update), bytes(32)))
    assert servo.apply(msgspec.msgpack.encode([sealed, sealed])) == 1
    assert servo.window(servo.waiting[1]) == first
    receipt = decode(servo.receipts.popleft())
    assert isinstance(receipt, Receipt)
    assert (receipt.servo, receipt.version, receipt.applied, servo.serial) == ("ax-7", 4, True, 9)
    servo.cut(0.35, 0.1)
    assert [cut.version for cut in servo.waiting] == [0, 0, 0, 4]
