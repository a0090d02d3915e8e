"""Deployed processes in lock-step do what the co-simulation does, to the last bit."""

import socket
import sqlite3
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from lock_step import HttpTwin, LockStep, lock_step
from machines import machine, served
from services import service

from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated import supervise, wire
from servotwin.drives.simulated.client import SimulatedSupervised
from servotwin.errors import InvalidInput
from servotwin.messages import Update, decode, encode
from servotwin.twin.evidence_rows import plain

SCENARIO = """
servo = "paper"
name = "axis"
duration_s = {duration}
seed = 7
[reference]
kind = "square"
amplitude_mm = 1.0
period_s = {period}
[gap]
from_deg = 0.0
to_deg = 8.0
over_s = {duration}
[disturbances]
input_bias_v = 0.02
[recording]
sample_rate_hz = 5000.0
fine_angle = {fine}
[controller]
sample_rate_hz = 5000.0
[link]
delay_s = 0.3
jitter_s = 0.5
loss = 0.15
duplicate = 0.15
reorder = 0.2
hold_s = 2.0
[twin]
{twin}
"""
CERTIFIED = """policy = "certified"
demands = {velocity_feedforward = false, friction_feedforward = false, notch = false}
"""
"""With fewer candidates: both sides verify them all."""
TWIN = """
[service]
store = "sqlite:///twin.db"
lockstep = true
workers = 1
[models.own]
servo = "{servo}"
{controller}
[models.own.twin]
{twin}
[servos]
axis = "own"
"""
PAPER = "[models.own.controller]\nsample_rate_hz = 5000.0\n"


def deployed(folder: Path, scenario: Scenario, twin: str, *, servo: str = "paper", thread: bool = False) -> LockStep:
    """The scenario on a machine and a twin in processes of their own, or on a machine in a `thread` of this one."""
    (folder / "machine.toml").write_text(
        'scenario = "scenario.toml"\nrole = "supervise"\nlisten = "127.0.0.1:0"\nspeed = 0.0\nendless = false\n'
    )
    controller = PAPER if servo == "paper" else ""
    (folder / "twin.toml").write_text(TWIN.format(twin=twin, servo=servo, controller=controller))
    with ExitStack() as stack:
        path = folder / "machine.toml"
        address = stack.enter_context(served(path)) if thread else stack.enter_context(machine(path))[0]
        url = stack.enter_context(service(folder / "twin.toml"))
        drive, remote = SimulatedSupervised(address), HttpTwin(url, "axis")
        try:
            drive.connect()
            return lock_step(scenario, remote, drive)
        finally:
            remote.close()
            drive.close()


def stored(folder: Path, kind: str) -> dict[tuple[str, int], bytes]:
    """Evidence of a kind by window."""
    database = sqlite3.connect(folder / "twin.db")
    try:
        rows = database.execute(
            "select boot, sequence, body from evidence join messages on messages.id = message where evidence.kind = ?",
            (kind,),
        ).fetchall()
    finally:
        database.close()
    assert len({row[:2] for row in rows}) == len(rows)
    return {(boot, sequence): body for boot, sequence, body in rows}


def in_memory(loop: Loop) -> dict[tuple[str, int], bytes]:
    """The co-simulation's estimates by window, as they would be stored."""
    return {
        (window.boot, window.sequence): plain(estimate)
        for window, estimate in zip(loop.windows, loop.estimates, strict=True)
    }


def check_deployed_is_simulated(loop: Loop, result: LockStep, folder: Path) -> None:
    """The same windows, estimates, updates and receipts, bit for bit, over a link that loses, repeats and reorders."""
    sent = {encode(message.message) for message in loop.messages if message.direction == "up"}
    assert {encode(window) for window in result.windows} <= sent
    assert [encode(each) for each in result.receipts] == [encode(each) for each in loop.receipts]
    assert dict.fromkeys(encode(each) for each in result.sent if isinstance(each, Update)) == dict.fromkeys(
        encode(decode(encode(update))) for update in loop.updates
    )
    estimates = {key: msgspec.msgpack.decode(body)["estimate"] for key, body in stored(folder, "estimate").items()}
    simulated = {key: msgspec.msgpack.decode(body) for key, body in in_memory(loop).items()}
    # As text: a window that shows nothing has NaN, which equals nothing.
    assert sorted(map(repr, estimates.items())) == sorted(map(repr, simulated.items()))
    assert len(estimates) == len(loop.windows) >= 5


@pytest.mark.slow
def test_deployed_is_simulated_under_the_certified_policy(tmp_path: Path) -> None:
    """Under the paper's policy: the tests of `servotwin replay`, which need such a store."""
    text = SCENARIO.format(twin=CERTIFIED, duration=24.0, period=8.0, fine="true")
    (tmp_path / "scenario.toml").write_text(text)
    scenario = Scenario.load(tmp_path / "scenario.toml")
    loop, result = cosimulate(scenario), deployed(tmp_path, scenario, CERTIFIED)
    assert loop.updates
    check_deployed_is_simulated(loop, result, tmp_path)


AXIS = """
servo = "{axis}"
name = "axis"
duration_s = {duration}
[reference]
kind = "square"
{amplitude}
period_s = {period}
[gap]
from_deg = {gap[0]}
to_deg = {gap[1]}
over_s = {duration}
[link]
delay_s = 0.05
loss = 0.15
reorder = 0.2
[twin]
{twin}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "amplitude", "period", "gap"),
    [
        # The servo of the test above has such a law, and the next axis its own model.
        pytest.param(
            "ball-screw", "amplitude_mm = 0.3", 0.8, (0.5, 2.0), id="filtered PID", marks=pytest.mark.exploration
        ),
        pytest.param("two-mass-drive", "amplitude_deg = 6.0", 8.0, (0.4, 0.6), id="cascade, rotary"),
    ],
)
def test_a_deployed_axis_is_the_simulated_one(
    tmp_path: Path, axis: str, amplitude: str, period: float, gap: tuple[float, float]
) -> None:
    twin, duration = 'policy = "paper"\nk_dz = 0.5\n', 3.0 * period
    text = AXIS.format(axis=axis, amplitude=amplitude, period=period, gap=gap, duration=duration, twin=twin)
    (tmp_path / "scenario.toml").write_text(text)
    scenario = Scenario.load(tmp_path / "scenario.toml")
    loop, result = cosimulate(scenario), deployed(tmp_path, scenario, twin, servo=axis, thread=True)
    assert loop.updates
    check_deployed_is_simulated(loop, result, tmp_path)


def test_a_url_is_one() -> None:
    with pytest.raises(InvalidInput, match="must be http://HOST:PORT"):
        HttpTwin("127.0.0.1:80", "axis")


def test_a_machine_in_lock_step_waits_for_a_client_whose_twin_is_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervise, "_TRANSFER_S", 0.05)
    plant = SimpleNamespace(index=0, version=0, block=1, over=True, read=lambda *_: None, advance=lambda *_: None)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        serving = threading.Thread(target=supervise.SuperviseServer(plant, None).serve, args=(theirs,))
        serving.start()
        time.sleep(0.3)
        ours.send(wire.REQUEST.pack(wire.READ, 0, 1, 0, *(0.0,) * 15))
        ours.settimeout(10.0)
        assert wire.REPLY.unpack(wire.receive(ours, wire.REPLY.size))[0] == wire.OVER
        serving.join()
