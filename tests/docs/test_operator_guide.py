"""The operator's guide is true: what it names is what the code has, and its first five minutes are run as printed."""

import ast
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from service_system import twin_file

from servotwin.cli.app import app
from servotwin.cli.audit_report import Units
from servotwin.dashboard.machine_metrics import machine_metrics
from servotwin.edge import outlet
from servotwin.edge_process import outlet as pipe_outlet
from servotwin.edge_process.monitoring import read_status
from servotwin.link import outbox, sqlite_outbox
from servotwin.messages import Cause, Reason, Refusal, RequestOutcome
from servotwin.store.records import Backlog
from servotwin.store.store import open_store
from servotwin.twin_service.evidence_lines import ALARMS
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool

ROOT = Path(__file__).parents[2]
OPERATOR = ROOT / "docs/operator"
GUIDE, ALARM = (OPERATOR / "guide.md").read_text(), (OPERATOR / "alarms.md").read_text()
UNITS = OPERATOR / "systemd"
PATIENCE = 600.0
ROW = re.compile(r"^\|(.+)\|$", re.MULTILINE)
NAME = re.compile(r"`([^`]+)`")


def section(title: str, page: str = ALARM) -> str:
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert found is not None, title
    return found[1]


def rows(title: str) -> Iterator[list[str]]:
    """Cells of the rows of a section's tables that begin with a name."""
    for match in ROW.finditer(section(title).replace(r"\|", "¦")):
        cells = [cell.strip() for cell in match[1].split("|")]
        if NAME.match(cells[0]):
            assert all(cells), cells
            yield cells


def named(title: str) -> list[str]:
    """Names in the first cells."""
    return [name for cells in rows(title) for name in NAME.findall(cells[0])]


@cache
def trees(package: str) -> list[ast.Module]:
    """Parse every module of a package, so that a moved function is still found."""
    return [ast.parse(path.read_text()) for path in sorted((ROOT / "servotwin" / package).rglob("*.py"))]


def calls(package: str, *functions: str) -> set[str]:
    """First arguments, where they are texts, of calls of these names in a package."""
    nodes = [node for tree in trees(package) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    first = [node.args[0] for node in nodes if node.args and _last(node.func) in functions]
    either = [each for node in first if isinstance(node, ast.IfExp) for each in (node.body, node.orelse)]
    texts = [node.value for node in (*first, *either) if isinstance(node, ast.Constant)]
    return {text for text in texts if isinstance(text, str)}


def _last(node: ast.expr) -> str:
    """Name of what is called, with what it is a part of."""
    if isinstance(node, ast.Attribute):
        return f"{node.value.id}.{node.attr}" if isinstance(node.value, ast.Name) else f".{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def keys(package: str, function: str) -> set[str]:
    """Texts that are keys in the dictionaries of a function, or that it sets."""
    nodes = [node for tree in trees(package) for node in ast.walk(tree)]
    bodies = [node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == function]
    assert bodies, f"{package} has no function {function}"
    inside = [node for body in bodies for node in ast.walk(body)]
    made = [key for node in inside if isinstance(node, ast.Dict) for key in node.keys]
    put = [node.slice for node in inside if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store)]
    return {key.value for key in (*made, *put) if isinstance(key, ast.Constant) and isinstance(key.value, str)}


def counted(package: str, *names: str) -> set[str]:
    """Texts under which something is counted: counts["..."] += 1."""
    places = [node.target for tree in trees(package) for node in ast.walk(tree) if isinstance(node, ast.AugAssign)]
    inside = [node.slice for node in places if isinstance(node, ast.Subscript) and _last(node.value) in names]
    return {node.value for node in inside if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_every_refusal_is_explained_with_what_becomes_of_the_message() -> None:
    table = {cells[0].strip("`"): cells for cells in rows("Refusals")}
    assert list(table) != []
    assert set(table) == {each.value for each in Refusal}
    for refusal in Refusal:
        assert table[refusal.value][2] == ("kept" if refusal.temporary else "dropped"), refusal


@pytest.mark.parametrize(("title", "names"), [("Updates", Reason), ("Requests", RequestOutcome), ("Fallbacks", Cause)])
def test_every_answer_and_every_cause_is_explained(title: str, names: Any) -> None:
    assert sorted(named(title)) == sorted(each.value for each in names)


@pytest.fixture
def system(tmp_path: Path) -> Iterator[TwinService]:
    """A service that has not begun, with a broker, so that it has every metric."""
    twin = read_twin(twin_file(tmp_path, '[service.mqtt]\nurl = "mqtt://127.0.0.1:1"\n'))
    store = open_store(twin.service.store)
    made = TwinService(twin, store, pool=WorkerPool(0, twin.start, 1.0))
    try:
        made.http_app()
        yield made
    finally:
        made.commits.close()
        made.executor.close()
        store.close()


def test_every_metric_is_explained(system: TwinService) -> None:
    told = set(re.findall(r"^# TYPE (\S+)", system.metrics.text(), re.MULTILINE))
    explained = named("Metrics of the twin")
    assert {name for name in explained if name.startswith("servotwin_")} == told
    assert {name for name in explained if not name.startswith("servotwin_")} == calls(
        "twin_service", "counts.add", ".add"
    )
    machines = set(re.findall(r"^# TYPE (\S+)", machine_metrics([]), re.MULTILINE))
    assert set(named("Metrics of the machines")) == machines
    told |= machines
    everywhere = re.findall(r"\bservotwin_[a-z_]+", ALARM + GUIDE)
    assert {name for name in everywhere if not name.startswith("servotwin_edge_")} - told <= {"servotwin_version"}


def test_every_metric_of_an_edge_is_explained() -> None:
    made = calls("edge_process", "_Metric", "metric_lines")
    assert set(named("Metrics of an edge")) == made | {"servotwin_edge_tick_seconds"}


def test_every_field_of_health_is_explained(system: TwinService) -> None:
    assert set(named("Health of the twin")) == {*system.health(), "waiting"}
    assert all(f"`{name}`" in section("Health of the twin") for name in Backlog._fields)


def test_every_line_of_the_twin_s_log_is_explained() -> None:
    levels = [f"log.{level}" for level in ("debug", "info", "warning", "error", "exception")]
    assert sorted(named("Log of the twin")) == sorted(calls("twin_service", *levels) | set(ALARMS))


def test_every_line_of_an_edge_s_log_is_explained() -> None:
    said = calls("edge_process", "log") - {"trouble"}
    places = calls("edge_process", ".update", "troubles.update")
    explained = [cells[0] for cells in rows("Log of an edge")]
    assert {f"`trouble` where `{place}`" for place in places} == {each for each in explained if "where" in each}
    assert {each.strip("`") for each in explained if "where" not in each} == said


def test_every_reason_for_which_a_window_is_dropped_is_explained() -> None:
    reasons = (outlet.FILTERED, outlet.NOT_FINITE, outbox.FULL, sqlite_outbox.BROKEN, sqlite_outbox.UNWRITABLE,
               sqlite_outbox.INCOMPLETE, sqlite_outbox.LETTERS, pipe_outlet.BEHIND)  # fmt: skip
    assert sorted(named("Windows that are dropped")) == sorted(reasons)


def test_every_field_of_an_edge_s_status_is_explained() -> None:
    fields = set().union(*(keys("edge_process", name) for name in ("_status", "_gains", "summarise")))
    fields |= counted("edge_process", "self.counts", "edge.counts", ".counts") | counted("link", "self.counts")
    text = section("Status of an edge")
    assert fields - set(NAME.findall(text)) == set()
    faults = counted("edge_process", "self.faults", "self._faults")
    faults |= {sqlite_outbox.ANOTHER, sqlite_outbox.BROKEN, sqlite_outbox.UNWRITABLE, outlet.UNFILTERED}
    faults |= {sqlite_outbox.INCOMPLETE}
    assert faults - set(NAME.findall(text)) == set()


def test_every_kind_of_evidence_is_explained() -> None:
    kinds = calls("twin", "_computed", "_sent")
    assert set(NAME.findall("".join(cells[0] for cells in rows("Evidence of a window")))) == kinds | {"failed"}


def test_commands_are_printed_with_options_that_they_have() -> None:
    commands: Any = typer.main.get_command(app)
    code = re.findall(r"^```(?:ba)?sh\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    code += re.findall(r"`([^`\n]*servotwin [^`\n]+)`", GUIDE + ALARM)
    lines = re.findall(r"(?:^|bin/)servotwin ([a-z-]+)(.*)$", "\n".join(code), re.MULTILINE)
    assert len(lines) > 20
    for name, rest in lines:
        known = {option for parameter in commands.commands[name].params for option in parameter.opts}
        options = {word.partition("=")[0] for word in rest.partition("#")[0].split() if word.startswith("--")}
        assert options <= known, f"servotwin {name}{rest}"


@pytest.mark.parametrize("name", ["servotwin-twin.service", "servotwin-edge@.service"])
def test_units_are_what_the_service_manager_takes(tmp_path: Path, name: str) -> None:
    text = (UNITS / name).read_text()
    for line in ("NoNewPrivileges=yes", "ProtectSystem=strict", "Restart=always", "KillMode=mixed", "UMask=0077"):
        assert f"\n{line}\n" in text
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd here")
    (tmp_path / name).write_text(re.sub(r"ExecStart=/opt/\S+", f"ExecStart={sys.executable}", text))
    if "@" in name:
        (tmp_path / f"{name}.d").mkdir()
        shutil.copy(UNITS / "control.conf", tmp_path / f"{name}.d")
    done = subprocess.run(
        [analyze, "verify", "--man=no", str(tmp_path / name)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def blocks(language: str, title: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", section(title, GUIDE), re.MULTILINE | re.DOTALL)


def command(line: str) -> list[str]:
    """As printed, with this Python."""
    program, *rest = line.split()
    return [sys.executable, *([] if program == "python" else ["-m", "servotwin"]), *rest]


@contextmanager
def running(lines: list[str], folder: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes in groups of their own, what they say in files; nothing of them is left."""
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for number, line in enumerate(lines):
            with (folder / f"said-{number}").open("wb") as said:
                made = subprocess.Popen(command(line), cwd=folder, stdout=said, stderr=said, start_new_session=True)
            processes.append(made)
        yield processes
    finally:
        for each in processes:
            with suppress(ProcessLookupError):
                os.killpg(each.pid, signal.SIGKILL)
            each.wait()


def run_line(line: str, folder: Path) -> tuple[int, str]:
    done = subprocess.run(command(line), cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)
    return done.returncode, done.stdout + done.stderr


def state(looks: list[str], folder: Path) -> str:
    """What the commands that look say, and the end of what each process said."""
    said = [run_line(line, folder)[1] for line in looks]
    return "\n".join([*said, *(f"{file.name}: {file.read_text()[-2000:]}" for file in sorted(folder.glob("said-*")))])


@pytest.mark.slow
def test_the_first_five_minutes(tmp_path: Path) -> None:
    """Every file and every command as printed, but for the port, which somebody else may have, and the number of
    workers: a second one would have nothing to do.

    At five times real time a busy machine verifies settings more slowly than windows come: fewer updates are sent then,
    and those in time.
    """
    title = "First servo in five minutes"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    twin, machine = blocks("toml", title)
    assert "\nspeed = 5.0" in twin
    assert "\nspeed = 5.0" in machine
    (tmp_path / "twin.toml").write_text(twin.replace("[service]\n", f"[service]\nport = {port}\nworkers = 1\n"))
    (tmp_path / "machine.toml").write_text(machine)
    enroll, services, looks = ([line for line in block.splitlines() if line] for block in blocks("bash", title))
    assert [run_line(line, tmp_path)[0] for line in enroll] == [0]
    with running(services, tmp_path) as processes:
        (see_all, see_one), deadline, said = looks, time.monotonic() + PATIENCE, ""
        while " applied at sample " not in said:
            assert time.monotonic() < deadline, state(looks, tmp_path)
            assert all(each.poll() is None for each in processes), state(looks, tmp_path)
            if (read_status(tmp_path / "ax-1/status.json") or {}).get("version", 0) == 0:
                time.sleep(0.1)  # the command takes a second of the processor
                continue
            _, said = run_line(see_one, tmp_path)
        assert Units().head in said
        assert Units().head in GUIDE
        assert "expired" not in said
        # The bias at rest may be worth an update before a window shows the gap.
        while not re.search(r"^ax-1 +\d+\.\d+ ± \d+\.\d+ +ok", run_line(see_all, tmp_path)[1], re.MULTILINE):
            assert time.monotonic() < deadline, state(looks, tmp_path)
            assert all(each.poll() is None for each in processes), state(looks, tmp_path)
            time.sleep(3.0)  # the command takes a second of the processor, and a window comes every ten seconds
        for each in processes[::-1]:
            each.send_signal(signal.SIGINT)
            assert each.wait(PATIENCE) in (0, -signal.SIGINT)
    code, said = run_line("servotwin replay ax-1", tmp_path)
    assert code == 0
    assert "the same, bit for bit" in said
    for file in tmp_path.glob("said-*"):
        assert "Traceback" not in file.read_text()
