"""The edge as real processes: it controls without numbers libraries and without a twin, and survives kill -9."""

import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from faketwin import FakeTwin, Handler
from notify_socket import listening
from running_edge import RATE, RunningEdge, is_complete, sequences
from stubmachine import StubMachine
from waiting import until

from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import LinearLaw
from servotwin.edge.probe import ProbeLimits
from servotwin.edge_process.config import TwinLink
from servotwin.edge_process.config_file import edge_toml
from servotwin.messages import Hello, Receipt, Refusal, Setting, Update, WindowMessage


@pytest.fixture
def machine() -> Iterator[StubMachine]:
    with StubMachine(RATE) as machine:
        yield machine


@pytest.fixture
def twin() -> Iterator[FakeTwin]:
    with FakeTwin() as twin:
        yield twin


@pytest.fixture
def edge(tmp_path: Path, machine: StubMachine, twin: FakeTwin) -> Iterator[RunningEdge]:
    made = RunningEdge(tmp_path, machine, TwinLink(twin.url, "token", timeout_s=5.0, wait_s=1.0))
    yield made
    made.kill()


@pytest.mark.slow
def test_an_edge_controls_records_and_sends_without_numpy(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    with listening() as heard:
        edge.environment |= {"NOTIFY_SOCKET": str(heard.path), "WATCHDOG_USEC": "500000"}
        edge.start()
        until(lambda: len(twin.windows) >= 4 and edge.status().get("samples", 0) > 0)
        heard.wait_for("WATCHDOG=1", 2)
        assert edge.signal(signal.SIGTERM) == 0
        assert (heard.received()[0], heard.states[-1]) == ("READY=1", "STOPPING=1")
    (found,) = sequences(twin).values()
    left = {sequence for _, sequence in edge.outbox()}
    assert is_complete(sorted({*found, *left}))
    window = next(iter(twin.windows.values()))
    assert (window.samples, window.rate, window.reason) == (100, RATE, "reference")
    assert isinstance(twin.letters[0], Hello)
    assert max(machine.voltages) > 0.1
    assert machine.voltages[-1] == 0.0
    status = edge.status()
    assert (status["servo"], status["role"], status["version"]) == ("axis-1", "control", 0)
    assert status["tick"]["number"] == status["samples"]
    assert "secret" not in edge.log()


@pytest.mark.slow
def test_the_link_process_is_killed_again_and_again_and_the_controller_ticks_on(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    edge.start()
    for _ in range(3):
        until(lambda: edge.status().get("link_process", 0) > 0)
        os.kill(edge.status()["link_process"], signal.SIGKILL)
        (edge.folder / "status.json").unlink()
        machine.wait_for(machine.number + 300)
    count = len(twin.windows)
    until(lambda: len(twin.windows) >= count + 3)
    assert edge.signal(signal.SIGINT) == 0
    (found,) = sequences(twin).values()  # one boot: no sample was missed
    assert is_complete(found)
    assert machine.clients == 1
    assert edge.log().count("link process gone") == 3


@pytest.mark.slow
def test_kill_9_of_the_whole_edge_loses_at_most_the_window_being_cut(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    twin.fault = lambda handler, _: bool(handler.refuse(503, Refusal.UNAVAILABLE)) or True
    for _ in range(3):
        edge.start()
        before = len(edge.outbox())
        until(lambda: len(edge.outbox()) >= before + 3)  # noqa: B023
        edge.kill()
    kept = edge.outbox()
    twin.fault = None
    edge.start()
    until(lambda: set(kept) <= set(twin.windows))
    until(lambda: len(sequences(twin)) == 4)
    assert edge.signal(signal.SIGTERM) == 0
    assert len({boot.split("-")[0] for boot in sequences(twin)}) == 4
    assert all(map(is_complete, sequences(twin).values()))


@pytest.mark.slow
def test_the_status_counts_in_the_units_of_the_machine(edge: RunningEdge) -> None:
    law = Cascade(20.0, 0.01, 50.0, 0.1, sample_rate=RATE)
    edge.write(controller=law, command_unit="N m", position_unit="rad", twin=None)
    edge.start()
    until(lambda: edge.status().get("samples", 0) > 0)
    assert edge.signal(signal.SIGTERM) == 0
    status = edge.status()
    assert (status["tolerance_rad"], status["position_gain_per_s"], status["velocity_gain_n_m_s_per_rad"]) == (
        0.0, 20.0, 50.0,
    )  # fmt: skip
    assert not {"tolerance_m", "velocity_gain"} & status.keys()
    assert '"tolerance_rad":0.0' in edge.log().replace(" ", "")


@pytest.mark.slow
def test_the_status_of_a_linear_law_counts_in_the_units_of_the_machine(edge: RunningEdge) -> None:
    law = LinearLaw((), (), (), (2.0, 0.0, -2.0), feedforward=0.3, sample_rate=RATE)
    edge.write(controller=law, command_unit="N m", position_unit="rad", twin=None)
    edge.start()
    until(lambda: edge.status().get("samples", 0) > 0)
    assert edge.signal(signal.SIGTERM) == 0
    status = edge.status()
    assert (status["feedforward_n_m"], status["gain"], status["integral_share"]) == (0.3, 1.0, 1.0)
    assert "feedforward" not in status


@pytest.mark.slow
def test_without_a_twin_an_edge_controls_and_stores_windows(edge: RunningEdge, machine: StubMachine) -> None:
    edge.write(twin=None)
    edge.start()
    until(lambda: len(edge.outbox()) >= 3)
    assert edge.signal(signal.SIGTERM) == 0
    assert "up" not in edge.status()


@pytest.mark.slow
def test_a_terminal_that_is_closed_leaves_the_safe_voltage(edge: RunningEdge, machine: StubMachine) -> None:
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup the edge would ignore it, as it should
    edge.start()
    signal.signal(signal.SIGHUP, inherited)
    until(lambda: edge.status().get("samples", 0) > 0)
    assert edge.process is not None
    os.killpg(edge.process.pid, signal.SIGHUP)
    assert edge.process.wait(60) == 0
    assert machine.voltages[-1] == 0.0
    assert "link process gone" not in edge.log()


def update(window: WindowMessage, version: int) -> Update:
    known = (None, None, (None, None))
    identity, values = (window.boot, window.sequence), (Setting(1e-5 * version), window.start + 1000.0)
    return Update("axis-1", version, version - 1, identity, window.start, *known, "OK", *values)


@pytest.mark.slow
def test_over_a_bad_link_every_window_arrives_and_every_update_is_applied_once(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    """Answers fail before or after the twin has the window; updates come twice, sealed by others, and again later."""
    chance, versions = random.Random(1), iter(range(1, 1000))

    def fault(handler: Handler, _: bytes) -> bool:
        kind = chance.random()
        if kind < 0.2:
            handler.refuse(503, Refusal.UNAVAILABLE)
        elif kind < 0.4:
            handler.close_connection = True
        return kind < 0.4

    def answer(window: WindowMessage) -> None:
        if (window.boot, window.sequence) not in answered:
            answered.add((window.boot, window.sequence))
            message = update(window, next(versions))
            serial = twin.say(message)
            twin.say(message, serial)  # the same serial once more
            twin.say(message)  # the same update under another one
            twin.say(message, token="another servo's")

    answered: set[tuple[str, int]] = set()
    twin.fault, twin.on_window = fault, answer
    edge.start()
    until(lambda: len(twin.windows) >= 8)
    twin.fault = None
    until(lambda: len([x for x in twin.letters if isinstance(x, Receipt) and x.applied]) >= 3)
    assert edge.signal(signal.SIGTERM) == 0
    (found,) = sequences(twin).values()
    assert is_complete(found)
    receipts = {receipt.version: receipt for receipt in twin.letters if isinstance(receipt, Receipt)}
    applied = sorted(version for version, receipt in receipts.items() if receipt.applied)
    assert applied == list(range(1, len(applied) + 1))
    samples = [receipts[version].sample for version in applied]
    assert samples == sorted(samples)
    assert edge.status()["down"]["broken seal"] > 0


@pytest.mark.slow
def test_a_wrong_token_costs_no_window(edge: RunningEdge, machine: StubMachine, twin: FakeTwin) -> None:
    twin.token = "changed"
    edge.start()
    until(lambda: edge.status().get("up", {}).get("refused: bad_token", 0) > 1)
    assert len(twin.windows) == 0
    twin.token = "secret"
    until(lambda: len(twin.windows) >= 3)
    assert edge.signal(signal.SIGTERM) == 0
    (found,) = sequences(twin).values()
    assert is_complete(found)


@pytest.mark.slow
def test_samples_that_are_not_finite_hold_the_voltage_then_make_it_safe(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    bad = range(300, 340)
    machine.spoil = lambda n, *rest: (n, rest[0], float("nan"), float("nan")) if n in bad else (n, *rest)
    edge.start()
    machine.wait_for(500)
    assert edge.signal(signal.SIGTERM) == 0
    hold = round(0.01 * RATE)
    assert machine.voltages[300 : 300 + hold] == [machine.voltages[299]] * hold
    assert machine.voltages[300 + hold : 340] == [0.0] * (40 - hold)
    assert machine.voltages[340] != 0.0
    assert edge.status()["bad samples"] == 40
    assert edge.status()["windows"]["dropped"] == {"sample not finite": 1}


@pytest.mark.slow
def test_a_few_missing_samples_cost_their_window_only(edge: RunningEdge, machine: StubMachine, twin: FakeTwin) -> None:
    machine.spoil = lambda n, *rest: (n if n < 300 else n + 7, *rest)
    edge.start()
    until(lambda: len(twin.windows) >= 4)
    assert edge.signal(signal.SIGTERM) == 0
    (found,) = sequences(twin).values()
    assert sorted({*found, 1}) == list(range(len(found) + 1))  # cut from sample 250 on
    assert edge.status()["samples missed"] == 7
    assert edge.status()["windows"]["dropped"] == {"sample not finite": 1}
    assert twin.windows[next(reversed(twin.windows))].start * RATE % machine.every == 7


@pytest.mark.slow
def test_many_missing_samples_begin_a_new_boot_and_the_law_goes_on(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    machine.spoil = lambda n, *rest: (n if n < 300 else n + 700, *rest)
    edge.start()
    until(lambda: len(sequences(twin)) == 2)
    assert edge.signal(signal.SIGTERM) == 0
    first, second = sequences(twin)
    assert second == f"{first}.1"
    assert edge.status()["boot: samples missing"] == 1
    assert machine.voltages[300] == pytest.approx(machine.voltages[299], rel=0.2)


def test_a_wrong_configuration_ends_with_one_sentence(edge: RunningEdge, machine: StubMachine) -> None:
    (edge.folder / "token").chmod(0o644)
    edge.start()
    assert edge.process is not None
    assert edge.process.wait(60) == 2
    assert "twin.token_file = 'token': " in edge.log()
    assert "has mode 0644" in edge.log()
    assert "Traceback" not in edge.log()


@pytest.mark.slow
def test_probing_moves_are_refused_where_the_drive_cannot_make_them(edge: RunningEdge) -> None:
    agent = replace(edge.config.agent, controller=None, probe=ProbeLimits(1e-4))
    (edge.folder / "run.csv").write_text("time_s,reference_m,theta_m_rad,position_m,voltage_v\n0,0,0,0,0\n")
    edge.write(role="supervise", controller=None, agent=agent, drive={"kind": "replay", "log": "run.csv"})
    edge.start()
    assert edge.process is not None
    assert edge.process.wait(60) == 2
    assert "edge.toml: edge.probe: this drive cannot move its reference" in edge.log()


@pytest.mark.slow
def test_a_second_edge_on_the_same_files_is_refused_and_the_first_goes_on(
    edge: RunningEdge, machine: StubMachine
) -> None:
    edge.start()
    until(lambda: len(machine.voltages) > 100)
    command = [sys.executable, "-m", "servotwin.edge_process", str(edge.folder / "edge.toml")]
    second = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (second.returncode, second.stderr.count("\n")) == (2, 1)
    assert "another edge runs on its files" in second.stderr
    other = replace(edge.config, files=replace(edge.config.files, parameters="other.json"))
    (edge.folder / "other.toml").write_text(edge_toml(other))
    third = subprocess.run([*command[:-1], str(edge.folder / "other.toml")], timeout=60, check=False)
    assert third.returncode == 2
    before = len(machine.voltages)
    until(lambda: len(machine.voltages) > before + 100)
    edge.kill()
    edge.start()
    until(lambda: len(machine.voltages) > before + 300)
    assert edge.signal(signal.SIGTERM) == 0


@pytest.mark.slow
def test_a_full_disk_stops_neither_the_controller_nor_the_link(
    edge: RunningEdge, machine: StubMachine, twin: FakeTwin
) -> None:
    """A limit on the size of the link process's files stands for the disk; later there is room again."""
    edge.start()
    until(lambda: edge.status().get("link_process", 0) > 0)
    link, count = edge.status()["link_process"], len(twin.windows)
    before = resource.prlimit(link, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    until(lambda: not edge.status()["disk"]["safe"])
    until(lambda: len(twin.windows) >= count + 4)
    assert edge.status()["disk"]["faults"]["disk not writable"] > 0
    resource.prlimit(link, resource.RLIMIT_FSIZE, before)
    until(lambda: edge.status()["disk"]["safe"])
    assert edge.signal(signal.SIGTERM) == 0
    (found,) = sequences(twin).values()
    assert is_complete(found)
    assert edge.status()["windows"]["dropped"] == {}
    assert edge.status()["link_process"] == link


@pytest.mark.slow
def test_a_link_process_that_is_killed_on_a_full_disk_takes_no_window_along(
    edge: RunningEdge, machine: StubMachine
) -> None:
    edge.write(twin=None)
    edge.start()
    until(lambda: edge.status().get("link_process", 0) > 0)
    link = edge.status()["link_process"]
    resource.prlimit(link, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    until(lambda: not edge.status()["disk"]["safe"])
    machine.wait_for(machine.number + 500)
    os.kill(link, signal.SIGKILL)
    until(lambda: edge.status()["link_process"] != link and edge.status()["disk"]["safe"])
    assert edge.signal(signal.SIGTERM) == 0
    assert is_complete([sequence for _, sequence in edge.outbox()])
    assert len(edge.outbox()) >= 4
