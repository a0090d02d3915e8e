"""Deployed and free-running, in its own time, the loop gives the estimates of the co-simulation."""

import json
import math
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from deployment import Process
from machines import machine
from records import UNACKNOWLEDGED
from services import service

from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated.machine_state import write_speed
from servotwin.plant.signals import as_pieces
from servotwin.twin_service.auth import Verifiers, write_tokens
from servotwin.up.enrolment import Enrolment, enroll

RATE, DURATION, PERIOD, SPEED = 1000.0, 40.0, 4.0, 5.0
FROM_DEG, TO_DEG = 4.0, 12.0
TWIN_TABLE = """
policy = "paper"
initial_gap_deg = 4.0
"""
SCENARIO = f"""
servo = "paper"
name = "axis"
duration_s = {DURATION}
[reference]
kind = "square"
amplitude_mm = 1.0
period_s = {PERIOD}
[gap]
from_deg = {FROM_DEG}
to_deg = {TO_DEG}
over_s = {DURATION}
[recording]
sample_rate_hz = {RATE}
[controller]
sample_rate_hz = {RATE}
[noise]
std_mm = 0.001
[twin]{TWIN_TABLE}
"""
TWIN = f"""
[service]
store = "sqlite:///twin.db"
workers = 1
speed = {2 * SPEED}
tokens = "tokens.toml"
[models.paper]
servo = "paper"
[models.paper.controller]
sample_rate_hz = {RATE}
[models.paper.twin]{TWIN_TABLE}
[servos]
axis = "paper"
"""
MACHINE = """
scenario = "scenario.toml"
role = "supervise"
listen = "127.0.0.1:0"
speed = 1.0
speed_file = "speed"
block_s = 0.005
slack_s = 60.0
keep_s = 100.0
"""


@pytest.mark.slow
def test_free_running_is_simulated(tmp_path: Path) -> None:
    """The same windows are accepted, and the gap lies within its interval as often as it should."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    scenario = Scenario.load(tmp_path / "scenario.toml")
    loop = cosimulate(scenario)
    simulated = {
        change_before(window.start): estimate.ok for window, estimate in zip(loop.windows, loop.estimates, strict=True)
    }
    free = {change_before(start): result for start, result in free_running(tmp_path).items()}
    missed = joined_at(tmp_path)
    accepted = {change for change, result in free.items() if result["status"] == "ok"}
    common = set(free) & set(simulated)
    # On a busy machine newer windows overtake some, which are then stored only.
    assert len(common) >= 15
    assert accepted & common == {change for change, ok in simulated.items() if ok} & common
    assert len(accepted) >= 12
    gap_at = as_pieces(scenario.gap, DURATION)
    result = [(free[change], float(gap_at.value(free[change]["time"] + missed))) for change in accepted]
    assert sum(low <= gap <= high for each, gap in result for low, high in [each["interval"]]) >= len(result) - 2
    assert max(abs(math.degrees(each["gap"] - gap)) for each, gap in result) < 0.02


def free_running(folder: Path) -> dict[float, dict]:
    """Estimates by the start of their windows, s of machine time, of a twin, an edge and a machine on their own."""
    (folder / "machine.toml").write_text(MACHINE)
    (folder / "twin.toml").write_text(TWIN)
    write_tokens(folder / "tokens.toml", Verifiers())
    write_speed(folder / "speed", 5e-3)  # the edge comes to the first sample, or to one soon after it
    with machine(folder / "machine.toml") as (address, _), service(folder / "twin.toml") as url:
        drive = {"kind": "simulated", "address": address, "silence_s": 0.0}
        enroll(
            folder / "twin.toml",
            Enrolment("axis", folder / "axis", role="supervise", sample_rate=RATE, drive=drive, url=url),
        )
        edge = Process("edge", folder, folder / "axis", ["-m", "servotwin.edge_process", "edge.toml"])
        edge.start()
        try:
            wait(lambda: reached(folder) > 0)
            write_speed(folder / "speed", SPEED)
            wait(lambda: reached(folder) > RATE * DURATION and settled(folder))
            assert edge.end() == 0
        finally:
            edge.kill()
    return estimates(folder)


def joined_at(folder: Path) -> float:
    """s of machine time that had passed when the edge came."""
    status = json.loads((folder / "axis" / "status.json").read_text())
    return (status["drive_sample"] - status["samples"]) / RATE


def change_before(start: float) -> float:
    """The change of the reference with which a window begins, s."""
    return round(start / (PERIOD / 2)) * PERIOD / 2


def reached(folder: Path) -> int:
    """Samples that the edge has seen, as it said last."""
    try:
        return int(json.loads((folder / "axis" / "status.json").read_text())["samples"])
    except (FileNotFoundError, KeyError):
        return 0


def settled(folder: Path) -> bool:
    """True once the edge has sent all windows and all messages are processed."""
    sent = ask(folder / "axis" / "outbox.sqlite", f"select count(*) from windows where {UNACKNOWLEDGED}") == [(0,)]
    return sent and ask(folder / "twin.db", "select count(*) from messages where done is null") == [(0,)]


def estimates(folder: Path) -> dict[float, dict]:
    text = "select start, evidence.body from evidence join messages on messages.id = message where evidence.kind = ?"
    rows = ask(folder / "twin.db", text, "estimate")
    return {start: msgspec.msgpack.decode(body)["estimate"] for start, body in rows if start < DURATION - PERIOD / 2}


def ask(file: Path, text: str, *values: str) -> list[tuple]:
    with closing(sqlite3.connect(file)) as database:
        return database.execute(text, values).fetchall()


def wait(until: object, patience: float = 400.0) -> None:
    assert callable(until)
    end = time.monotonic() + patience
    while not until():
        assert time.monotonic() < end
        time.sleep(0.1)
