"""`servotwin up` with real processes: it runs, ends, resumes, and leaves nothing behind, however it ends."""

import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import Request, urlopen

import pytest
from rich.console import Console
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.drives.simulated.machine_state import read_state
from servotwin.edge_process.config_file import load
from servotwin.edge_process.monitoring import read_status
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.store.store import open_store
from servotwin.up import command, folder
from servotwin.up.demonstration import SERVOS
from servotwin.up.outages import Outages
from servotwin.up.plan import Plan
from servotwin.up.site import Site

RUNNING = "x real time"
PATIENCE_S = 120.0
NUMBER = 2
"""Servos: one whose edge runs the law, one whose machine does; a third one would only take its time."""
COMMAND = f"""
from servotwin.up import demonstration

demonstration.SERVOS = tuple(servo._replace(model="dead-zone") for servo in demonstration.SERVOS[:{NUMBER}])

from servotwin.cli.app import main

main()
"""
"""Without the certified policy, whose verifications would take most of the time."""
STARTED = SERVOS[:NUMBER]


@contextmanager
def started(path: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`servotwin up` in a group of its own; whatever is left of it in the end is killed."""
    arguments = [sys.executable, "-c", COMMAND, "up", "--folder", str(path), *options]
    process = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    assert process.stdout is not None
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        process.stdout.close()
        for pid in left_behind(path):
            os.kill(pid, signal.SIGKILL)


def lines_until(process: subprocess.Popen[str], what: str) -> list[str]:
    """The lines up to the one that says it."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if what in line:
            return lines
    raise AssertionError("".join(lines))


def left_behind(path: Path) -> list[int]:
    """Processes that work in a folder."""
    result = []
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes() if entry.name.isdecimal() else b""
        except OSError:
            continue
        if b"servotwin.runtime.child_process" in words and os.fsencode(path) in words:
            result.append(int(entry.name))
    return result


def eventually(holds: Callable[[], bool]) -> bool:
    end = time.monotonic() + PATIENCE_S
    while not holds() and time.monotonic() < end:
        time.sleep(0.05)
    return holds()


def times(path: Path) -> list[float]:
    """Machine time of each servo, s."""
    states = [read_state(path / servo.name / "state.json") for servo in STARTED]
    return [0.0 if state is None else state.time_s for state in states]


def live_state(url: str, token: str, servo: str) -> str:
    """State of a machine's live view, for a page that asks."""
    headers = {"authorization": f"Bearer {token}"}
    with urlopen(Request(f"{url}/v1/servos/{servo}/live", headers=headers), timeout=20.0) as answer:
        state: str = json.load(answer)["state"]
    return state


def stored(path: Path) -> dict[str, set[str]]:
    """The numbers of the boots of which the twin has windows, by servo: b1 is the first."""
    store = open_store(f"sqlite:///{path / 'twin.db'}")
    try:
        audits = {servo.name: store.audit(servo.name, None, 1000) for servo in STARTED}
        return {name: {link.window.boot.partition("-")[0] for link in links} for name, links in audits.items()}
    finally:
        store.close()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")
def test_it_continues_after_a_kill_and_ends_in_order(tmp_path: Path) -> None:
    """What it finds after an orderly end is what it leaves at every time, and a kill is the worst one."""
    path = tmp_path / "up"
    with started(path, "--speed", "10") as first:
        lines = lines_until(first, RUNNING)
        assert lines[0].startswith("making ")
        [address] = [line for line in lines if line.startswith("twin: listening on http://127.0.0.1:")]
        assert lines.index(address) < len(lines) - 1
        assert eventually(lambda: min(times(path)) > 5.0)
        secrets = [path / "tokens.toml", path / "operator.token", *(path / servo.name / "token" for servo in STARTED)]
        assert {file.stat().st_mode & 0o777 for file in secrets} == {0o600}
        in_use = f"in use by another servotwin up .process {first.pid}"
        with pytest.raises(InvalidInput, match=in_use), folder.opened(path):
            pass
        first.kill()
        first.wait()
        before = times(path)
        # At once: what the kill left behind still ends.
        with started(path, "--speed", "10") as second:
            lines = lines_until(second, RUNNING)
            assert sum(line.startswith("continuing with") for line in lines) == NUMBER
            # Both roles show their samples live, as their files allow it.
            url = next(line.split()[-1] for line in lines if line.startswith("twin: listening on "))
            token = (path / "operator.token").read_text().strip()
            assert eventually(lambda: all(live_state(url, token, servo.name) == "live" for servo in STARTED))
            # However slow this machine: each servo's windows come from a boot after the first.
            assert eventually(lambda: all(boots - {"b1"} for boots in stored(path).values()))
            second.send_signal(signal.SIGINT)
            lines = lines_until(second, "all processes have ended")
            assert sum(": gap" in line or "of machine time, gap" in line for line in lines) == NUMBER
            assert second.wait(PATIENCE_S) == 0
    assert eventually(lambda: not left_behind(path))
    assert all(after > former + 5.0 for former, after in zip(before, times(path), strict=True))
    assert not list(path.glob("*/drive.sock"))
    with folder.opened(path) as left:
        assert not left.new


SCENARIO = """
servo = "screw.toml"
name = "screw"
duration_s = 600.0
reference = {kind = "square", amplitude_mm = 0.3, period_s = 2.0}
gap = {from_deg = 0.5, to_deg = 3.0, over_s = 600.0}
twin = {policy = "paper", k_dz = 0.5}
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")
def test_machines_of_an_own_axis_run_get_updates_and_their_estimates_repeat(tmp_path: Path) -> None:
    (tmp_path / "screw.toml").write_text(Axis.preset("ball-screw").dumps())
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    path, names = tmp_path / "up", ("screw-1", "screw-2")
    with started(path, str(tmp_path / "scenario.toml"), "--machines", "2") as process:
        lines_until(process, RUNNING)
        status = [path / name / "status.json" for name in names]
        assert eventually(lambda: all((read_status(file) or {}).get("version", 0) > 0 for file in status))
        process.send_signal(signal.SIGINT)
        lines = lines_until(process, "all processes have ended")
        assert process.wait(PATIENCE_S) == 0
    for name in names:
        assert any(line.startswith(f"{name}: ") for line in lines)
        done = CliRunner().invoke(app, ["replay", name, "--config", str(path / "twin.toml")])
        assert done.exit_code == 0
        assert "the same, bit for bit" in done.stdout
    assert eventually(lambda: not left_behind(path))


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InvalidInput, match="was not made by this version of servotwin up"), folder.opened(tmp_path):
        pass
    assert [each.name for each in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_path_too_long_for_sockets_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 100)
    with pytest.raises(InvalidInput, match="too long for the sockets"), folder.opened(path):
        pass
    assert not path.exists()


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInput, match="file"), folder.opened(tmp_path / "file" / "up"):
        pass


def test_the_first_start_says_what_takes_so_long_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, said = io.StringIO(), []

    def make(path: Path, _plan: Plan) -> None:
        said.append(written.getvalue())
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(folder, "_make", make)
    with pytest.raises(InvalidInput, match="no space left"):
        command.up(tmp_path / "up", console=Console(file=written, width=300))
    makes = "a twin for quick, noisy, remote (the very first time, code is compiled for minutes) ..."
    assert said == [f"making {tmp_path / 'up'}: {makes}\n"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a first start, of which nothing was started."""
    path = tmp_path_factory.mktemp("first") / "up"
    with folder.opened(path) as first:
        assert first.new
    return path


@pytest.mark.slow
def test_it_ends_by_itself_after_the_time_that_is_given(made: Path) -> None:
    with folder.opened(made) as opened:
        site = Site(opened, Outages(), lambda: 0)
        site.twin.address = "http://127.0.0.1:1"
        console = Console(file=io.StringIO())
        monitor = command._Monitor(opened, site, 10.0, console)
        begun = time.monotonic()
        monitor.run(lambda: int(time.monotonic() > begun + PATIENCE_S), 0.3)
        assert 0.3 <= time.monotonic() - begun < PATIENCE_S
        monitor.stop()
        monitor.print_summary()
    assert "all processes have ended" in console.file.getvalue()


@pytest.mark.slow
def test_a_made_folder_is_whole_or_refused_and_one_at_a_time(made: Path) -> None:
    with folder.opened(made) as opened:
        assert opened.machine(opened.servos[0]) is None
        with pytest.raises(InvalidInput, match=f"another servotwin up .process {os.getpid()}"), folder.opened(made):
            pass
        opened.connect(opened.servos[0], "http://127.0.0.1:4321")
        assert 'url = "http://127.0.0.1:4321"' in (made / SERVOS[0].name / "edge.toml").read_text()
    assert [each.name for each in made.parent.iterdir()] == ["up"]
    bands = {servo.name: load(made / servo.name / "edge.toml").agent.supervision.fallback for servo in SERVOS}
    errors = {name: None if fallback is None else fallback.setting.band.error for name, fallback in bands.items()}
    assert errors["noisy"] == pytest.approx(errors["quick"] + 0.05e-3)  # the edge puts up with its encoder's noise
    with folder.opened(made) as again:
        assert not again.new
    (made / SERVOS[1].name / "token").unlink()
    with pytest.raises(InvalidInput, match=f"{SERVOS[1].name}/token is missing"), folder.opened(made):
        pass


def test_an_invalid_speed_is_refused_by_the_command(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["up", "--folder", str(tmp_path / "up"), "--speed", "0"])
    assert done.exit_code == 2
    assert "--speed" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "up").exists()


@pytest.mark.parametrize(("option", "value"), [("--speed", 101.0), ("--for", -1.0)])
def test_an_invalid_speed_or_time_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, value: float
) -> None:
    monkeypatch.setattr(command, "opened", lambda *_: pytest.fail("it starts"))
    with pytest.raises(InvalidInput, match=option):
        command.up(tmp_path / "up", **{"speed" if option == "--speed" else "seconds": value})
