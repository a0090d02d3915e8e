"""`servotwin bench fleet`: its edges without a twin, its line without a socket, and all of it once, small."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from twin_messages import window_message
from typer.testing import CliRunner

from benchmarks.fleet import findings
from benchmarks.fleet.edge_load import EdgeLoad
from benchmarks.fleet.edges import EdgeTurn
from benchmarks.fleet.line import HttpConnection
from benchmarks.fleet.plan import LoadPlace, LoadPlan, LoadStart, decode_load, encode_load, shares
from benchmarks.fleet.processes import MachineTimes, ProcessUsage, children, machine_times, used
from benchmarks.fleet.runs import FleetRun
from benchmarks.fleet.setting import QUICK
from benchmarks.fleet.stock import BOOT, COMMISSIONED, PERIOD, WindowSource, commissioned, readdressed
from benchmarks.fleet.store import measure
from benchmarks.fleet.tables import lines
from benchmarks.fleet.watch import EDGES, TWIN, WORKERS, ResourceSample, ResourceWatch
from servotwin.cli.app import app
from servotwin.estimation.learning.wear import Wear
from servotwin.link.seal import TO_EDGE, key_of, seal, verifier_of
from servotwin.messages import Receipt, Setting, Update, decode, encode
from servotwin.redesign.certified.lookup import Grid
from servotwin.store.records import EvidenceRecord, Incoming, MessageKind, WorkResult
from servotwin.store.store import open_store
from servotwin.twin.state import TwinState, Versions

PLAN = LoadPlan(1, 4, "boot-9", 2, duration=2.0, rate=10.0, start=200.0)


def load(plan: LoadPlan = PLAN, places: int = 2) -> LoadStart:
    def place(p: int) -> LoadPlace:
        *usual, moved = (encode(window_message(sequence=10 * p + k, start=5.0)) for k in range(3))
        return LoadPlace(0.1 * (1 + p), 3, tuple(usual), moved)

    return LoadStart(plan, tuple(place(p) for p in range(places)))


def fleet(plan: LoadPlan = PLAN) -> EdgeLoad:
    return EdgeLoad(load(plan), 0.0)


def sent(edges: EdgeLoad, now: float, pause: float = 0.0) -> tuple[str, float]:
    """Have the twin take the next window; its servo, and when it fell due."""
    edge = edges.take(now)
    due = edge.on_its_way.due
    edges.taken(edge, now, pause)
    return edge.name, due


# --- what is sent


def test_a_window_is_readdressed_and_stays_whole() -> None:
    one = window_message(sequence=1, start=5.0)
    one = msgspec.structs.replace(one, reference_changes=((5.1, 1e-3),))
    other = decode(encode(readdressed(one, "ax-1", 7, 300.0, 4)))
    assert (other.servo, other.boot, other.sequence, other.parameter_version) == ("ax-1", BOOT, 7, 4)
    assert other.channels == one.channels
    assert other.reference_changes == ((pytest.approx(300.1), 1e-3),)


def test_windows_fall_due_at_the_rate_and_no_more_than_the_plan_has() -> None:
    edges = fleet()
    edges.add_due(0.0)
    assert edges.waiting == 1
    edges.add_due(0.55)
    assert edges.waiting == 6
    edges.add_due(100.0)
    assert edges.waiting == 20
    taken = [sent(edges, 100.0) for _ in range(20)]
    assert [due for _, due in taken] == pytest.approx([0.1 * k for k in range(20)])
    assert [name for name, _ in taken][:5] == ["ax-00000", "ax-00001", "ax-00002", "ax-00003", "ax-00000"]
    assert edges.take(100.0) is None


def test_in_an_outage_windows_wait() -> None:
    edges = fleet(msgspec.structs.replace(PLAN, outage=(0.5, 1.5)))
    edges.add_due(1.0)
    assert edges.take(1.0) is None
    assert edges.waiting == 11
    assert edges.take(1.5) is not None
    assert edges.undisturbed(0.4)
    assert not edges.undisturbed(1.0)


def test_after_an_outage_each_edge_sends_in_the_order_of_a_real_one() -> None:
    """Its newest window at once where the twin has asked for pauses, and the older ones after them."""
    edges = fleet(msgspec.structs.replace(PLAN, outage=(0.5, 3.0), duration=20.0))
    for k in range(4):
        edges.add_due(0.1 * k)
        sent(edges, 0.1 * k, pause=20.0)
    edges.add_due(3.0)
    edges.take(1.0)
    dues = [sent(edges, 3.0, pause=5.0)[1] for _ in range(4)]
    assert (sorted(dues), edges.take(3.0)) == (pytest.approx([2.7, 2.8, 2.9, 3.0]), None)
    assert edges.waiting == 23
    dues = [sent(edges, 8.0, pause=5.0)[1] for _ in range(4)]
    assert (sorted(dues), edges.take(8.0)) == (pytest.approx([0.4, 0.5, 0.6, 0.7]), None)


def test_without_a_rate_a_window_is_due_whenever_one_may_be_sent() -> None:
    edges = fleet(msgspec.structs.replace(PLAN, rate=0.0))
    assert [edges.take(0.1 * k).name for k in range(5)] == [
        "ax-00000",
        "ax-00001",
        "ax-00002",
        "ax-00003",
        "ax-00000",
    ]
    assert edges.take(2.0) is None


def test_news_moves_the_gap_to_the_next_place_and_keeps_it_there() -> None:
    edges = fleet(msgspec.structs.replace(PLAN, news=1.0))
    edge = edges.edges[0]
    first = decode(edges.window(edge, 0, 0.1))
    assert (edge.place, edges.counts.news) == (1, 1)
    assert first.channels == edges.moved[0].channels
    quiet = fleet()
    assert decode(quiet.window(quiet.edges[0], 0, 0.1)).channels == quiet.places[0][0].channels
    assert (first.start, first.sequence, first.parameter_version) == (pytest.approx(200.1), 0, 3)


def test_windows_are_of_the_setting_before_until_an_update_is_applied() -> None:
    edges = fleet(msgspec.structs.replace(PLAN, news=1.0))
    edge = edges.edges[0]
    edges.window(edge, 0, 0.1)
    edges.plan = PLAN
    assert decode(edges.window(edge, 1, 0.2)).channels == edges.moved[0].channels
    update = Update("ax-00000", 4, 3, ("boot-9", 0), 200.0, 0.19, 1e-3, (0.18, 0.2), "ok", Setting(0.0), 400.0)
    sealed = seal(key_of(verifier_of("")), TO_EDGE, "ax-00000", 1, encode(update))
    edges.apply_messages(edge, msgspec.msgpack.encode([sealed]))
    after = decode(edges.window(edge, 2, 0.3))
    assert (after.channels, after.parameter_version) == (edges.places[1][0].channels, 4)


def test_a_commissioned_twin_has_learnt_on_the_clock_and_waits_for_no_receipt(monkeypatch) -> None:
    times, letters, serial = [], [], iter(range(9))

    def work(_registry, lease, now):
        (message,) = lease.messages
        times.extend([message.received, now])
        update = Update("a", next(serial) + 1, 0, ("boot-1", 0), 0.0, 0.1, 1e-3, (0.0, 0.2), "ok", Setting(0.0), 9.0)
        letters.extend([decode(message.body)] if message.kind is MessageKind.LETTER else [])
        state = msgspec.msgpack.encode(TwinState("a", Versions(), {}, Wear(0.1)))
        sent = (encode(update),) if message.kind is MessageKind.WINDOW else ()
        return WorkResult("a", 0, state, None, (), outgoing=sent)

    monkeypatch.setattr("benchmarks.fleet.stock.work", work)
    place = WindowSource(0.1, (window_message(), window_message(1)), (), window_message(2))
    version = commissioned(None, "a", place, zero=1e9).version
    assert min(times) > 1e9 + COMMISSIONED - 2.5 * PERIOD
    assert max(times) < 1e9 + COMMISSIONED
    assert [(one.version, one.applied) for one in letters] == [(1, True), (version, True)]


def test_updates_are_applied_once_and_answered() -> None:
    edges = fleet()
    edge = edges.edges[1]
    update = Update("ax-00001", 4, 3, ("boot-9", 100), 200.0, 0.1, 1e-3, (0.09, 0.11), "ok", Setting(0.0), 400.0)
    key = key_of(verifier_of(""))
    body = msgspec.msgpack.encode([seal(key, TO_EDGE, "ax-00001", serial, encode(update)) for serial in (5, 6)])
    edges.apply_messages(edge, body)
    assert (edge.version, edge.serial, edges.counts.updates) == (4, 6, 1)
    (receipt,) = edge.receipts
    assert isinstance(receipt, Receipt)
    assert (receipt.version, receipt.applied, receipt.boot) == (4, True, "boot-9")


class Spoken:
    """A line that answers at once, from a list of answers."""

    def __init__(self, *answers, pause: float = 0.0) -> None:
        self.answers, self.requests, self.older_pause = list(answers), [], pause

    def ask(self, head, body, answered) -> None:
        self.requests.append((head.split(b" HTTP")[0].decode(), body))
        answered(*self.answers.pop(0))


def test_a_turn_polls_answers_and_sends() -> None:
    edges = fleet(msgspec.structs.replace(PLAN, polls=True))
    edge, failed = edges.edges[0], []
    edge.receipts.append(Receipt("ax-00000", 3, True, 1, "applied", 3, "boot-9"))
    line = Spoken((200, b"\x90"), (202, b""), (201, b"\x90"))
    turn = EdgeTurn(edges, line, asyncio.Event(), failed)
    edges.add_due(0.0)
    turn.begin(edges.take(0.0))
    assert [what for what, _ in line.requests] == [
        "GET /v1/servos/ax-00000/outgoing?after=0&wait=0",
        "POST /v1/servos/ax-00000/letters",
        "PUT /v1/servos/ax-00000/windows/boot-9/0",
    ]
    assert (edge.newest, edges.counts.windows, edges.counts.polls) == (0, 1, 1)
    assert turn.done.is_set()
    assert not failed


@pytest.mark.parametrize(("status", "kept", "failures"), [(503, 1, 0), (429, 1, 0), (400, 0, 1), (500, 0, 1)])
def test_a_postponed_window_is_sent_again_and_a_refused_one_ends_the_run(status: int, kept: int, failures: int) -> None:
    edges, failed = fleet(), []
    turn = EdgeTurn(edges, Spoken((status, b"")), asyncio.Event(), failed)
    edges.add_due(0.0)
    turn.begin(edges.take(0.0))
    assert (edges.waiting, len(failed), edges.counts.windows) == (kept, failures, 0)
    assert turn.done.is_set()


class Wire:
    """Takes what a line writes."""

    def __init__(self) -> None:
        self.written = b""

    def write(self, data: bytes) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return False


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_line_reads_answers_however_they_come(cut: int) -> None:
    broken, answers = [], []
    line, wire = HttpConnection(broken.append), Wire()
    line._transport = wire
    assert not line.closed
    whole = b"HTTP/1.1 201 Created\r\nServotwin-Older-Pause: 2.5\r\nContent-Length: 5\r\n\r\nhello"
    line.ask(b"PUT /x HTTP/1.1\r\n", b"body", lambda status, body: answers.append((status, body)))
    assert wire.written == b"PUT /x HTTP/1.1\r\nContent-Length: 4\r\n\r\nbody"
    line.data_received(whole[:cut])
    line.data_received(whole[cut:])
    assert (answers, line.older_pause) == ([(201, b"hello")], 2.5)
    line.connection_lost(None)
    assert line.closed
    assert not broken
    line._transport = wire
    line.ask(b"GET /y HTTP/1.1\r\n", b"", lambda status, body: answers.append((status, body)))
    line.connection_lost(None)
    assert broken


def test_a_load_comes_back_from_its_file() -> None:
    assert decode_load(encode_load(load())) == load()


def test_shares_are_the_median_the_99_percent_and_the_largest() -> None:
    assert shares([float(k) for k in range(101)]) == (50.0, 99.0, 100.0)
    assert shares([]) == (0.0, 0.0, 0.0)


# --- measurements


def test_the_usage_of_a_process_is_measured_until_it_ends() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        seen = used(process.pid)
        assert seen is not None
        assert seen.memory > 0
        assert process.pid in children(os.getpid())
    assert used(process.pid) is None


def watched(*samples: ResourceSample) -> ResourceWatch:
    return ResourceWatch(1, 2, lambda: (0, 0.0), list(samples))


def test_a_role_has_its_cores_and_memory_from_the_samples() -> None:
    def at(seconds: float, cpu: float, memory: int) -> ResourceSample:
        machine = MachineTimes(2.0 * seconds + cpu, 0.1 * seconds)
        return ResourceSample(seconds, {EDGES: ProcessUsage(cpu, memory)}, 0, 0.0, machine)

    watch = watched(at(0.0, 1.0, 10), at(1.0, 1.2, 30), at(4.0, 3.0, 20))
    assert watch.cores(EDGES) == pytest.approx(0.5)
    assert watch.memory(EDGES) == (10, 30, 30)
    assert watch.cores(TWIN) == 0.0
    assert watch.elsewhere() == pytest.approx((2.0, 0.1))
    assert watched().elsewhere() == (0.0, 0.0)


def test_the_machine_counts_the_time_of_its_processes() -> None:
    before, begun = machine_times(), time.process_time()
    while time.process_time() < begun + 0.1:
        pass
    after = machine_times()
    assert after.busy - before.busy >= 0.08
    assert after.withheld >= before.withheld


def test_the_store_shows_the_waiting_times_of_windows(tmp_path: Path) -> None:
    store = open_store(f"sqlite:///{tmp_path / 'x.db'}")
    try:
        items = [
            Incoming("a", MessageKind.WINDOW, f"b/{k}", b"x", "", bytes([k]) * 16, 100.0 + k, "b", k, float(k))
            for k in range(4)
        ]
        store.put(items)
        with findings.reading(tmp_path / "x.db") as reading:
            assert findings.waiting(reading, 110.0) == (4, 10.0)
            assert findings.stored(reading) == 4
            found = findings.done(reading, 101.0, 103.0)
            assert (found.windows, found.undone) == (2, 2)
            assert findings.fresh(reading, 2.0, 100.0) == []
            lease = store.lease("me", 1, 60.0, 110.0)[0]
            newest = EvidenceRecord("estimate", lease.messages[-1].id, b"")
            done = WorkResult("a", lease.serial, b"", None, tuple(m.id for m in lease.messages), evidence=(newest,))
            store.commit([done], 125.0)
            assert findings.fresh(reading, 2.0, 100.0) == [25.0]
            assert findings.fresh(reading, 4.0, 100.0) == []
            assert findings.fresh(reading, 2.0, 100.0, judged=True) == [25.0]
            assert findings.fresh(reading, 3.5, 100.0, judged=True) == []
            off = findings.worked_off(reading, 1.0, 3.0, 100.0)
            assert (off.windows, off.undone, off.came[2], off.processed[2]) == (2, 0, 2.0, 25.0)
            assert findings.made(reading, 0.0) == {"estimate": 1}
            assert findings.failures(reading) == []
    finally:
        store.close()


# --- all of it


@pytest.mark.slow
@pytest.mark.exploration
def test_a_small_fleet_runs_with_real_processes(tmp_path: Path, monkeypatch) -> None:
    kept: list[FleetRun] = []
    monkeypatch.setattr(
        "benchmarks.fleet.command.show", lambda _scale, alone, whole, _console: kept.extend((alone, whole))
    )
    # Few and wide cells: the bench's own table takes most of its time, and is looked up in the same way.
    monkeypatch.setattr("benchmarks.fleet.setting.GRID", Grid(math.radians(8.0), (1e-2,), (0.0,)))
    output = tmp_path / "fleet.json"
    shown = CliRunner().invoke(app, ["bench", "fleet", "--quick", "--json", str(output)])
    assert shown.exit_code == 0, shown.output
    alone, whole = kept
    assert alone.report.windows > 0
    sent = round(QUICK.rate * (QUICK.steady + QUICK.outage + QUICK.after))
    assert whole.report.windows == sent
    assert whole.made["glance"] == sent
    # Every window with news is estimated, and of the others those that are due.
    assert whole.report.news <= whole.made.get("estimate", 0) <= whole.report.news + 0.1 * sent
    assert whole.steady.undone == 0
    assert "alarm" not in whole.made  # each window is of the controller that is stated for it
    assert not math.isnan(whole.drained)
    assert {role for role in (EDGES, TWIN, WORKERS) if whole.watch.memory(role)[2] > 0} == {EDGES, TWIN, WORKERS}
    found = json.loads(output.read_text())
    assert found["schema"] == "servotwin-bench-fleet/1"
    assert len(found["lines"]) == len(list(lines(QUICK, alone, whole)))


def test_the_option_full_belongs_to_the_fleet_bench() -> None:
    for names in (["tick"], ["W1"], [], ["fleet", "--quick"]):
        shown = CliRunner().invoke(app, ["bench", *names, "--full"])
        assert shown.exit_code == 2
        assert "--full: only bench fleet or overload takes it" in shown.output


def test_the_bench_of_a_store_counts_what_its_rounds_did(tmp_path: Path) -> None:
    costs = []
    for rounds in (3, 6):
        store = open_store(f"sqlite:///{tmp_path}/{rounds}.db")
        try:
            costs.append(measure(store, 2, rounds))
        finally:
            store.close()
    for what in ("write", "lease"):
        few, many = (cost.statements[what] for cost in costs)
        assert 0 < 2 * few == many
        assert all(cost.seconds[what] > 0.0 for cost in costs)


def test_a_bench_that_is_terminated_cleans_up_as_after_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = list[str]()

    def run(*_arguments: object) -> bool:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10.0)
        finally:
            ended.append("cleaned up")
        return True

    monkeypatch.setattr("benchmarks.alone.run_alone", run)
    assert CliRunner().invoke(app, ["bench", "fleet"]).exit_code == 130
    assert ended == ["cleaned up"]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
