"""The benchmark: its timing is fair, what it writes is whole, bad input ends with a sentence."""

import io
import json
from itertools import count
from statistics import median

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from benchmarks import catalogue, command, report, solver, taylor
from benchmarks.contest import Check, Contestant, Workload
from benchmarks.measure import race, turns
from benchmarks.workloads import UNIT
from servotwin.cli.app import app
from servotwin.errors import InvalidInput

QUICK = catalogue.Options(quick=True)


def quiet():
    return Console(file=io.StringIO(), width=120)


# The timing.


class Jobs:
    """Contestants that only move a clock."""

    def __init__(self, **seconds):
        self.now, self.calls, self.seconds = 0.0, [], seconds

    def clock(self):
        return self.now

    def job(self, name):
        def run():
            self.calls.append(name)
            self.now += self.seconds[name]
            return np.array([self.seconds[name]])

        return run

    def workload(self, missing=()):
        taking_part = [Contestant(name, lambda name=name: self.job(name)) for name in self.seconds]
        absent = [Contestant(name, lambda: None, missing="not installed") for name in missing]
        check = Check("error", "s", lambda answer: float(answer[0]) - 1.0)
        return Workload("J", "jobs", (*taking_part, *absent), (check,), lambda seconds: f"{seconds:g} s each")


def test_contestants_take_turns():
    jobs, reported = Jobs(a=1.0, b=2.0), []
    workload = jobs.workload(missing=("c",))
    rows = race(workload, 3, 0.0, jobs.clock, reported.append)
    assert "".join(jobs.calls) == "aabb" + "ab" * 3
    assert len(reported) == turns(workload, 3)
    assert [row.median for row in rows[:2]] == [1.0, 2.0]
    assert rows[1].ratios(rows[0]) == (2.0, 2.0, 2.0)
    assert rows[1].errors == {"error": 1.0}
    assert rows[2].missing == "not installed"
    assert rows[2].rounds == ()


def test_short_jobs_are_repeated_within_their_turn():
    jobs = Jobs(short=0.01, long=3.0)
    short, long = race(jobs.workload(), 2, 0.1, jobs.clock, lambda _: None)
    assert [len(runs) for runs in short.rounds] == [10, 10]
    assert [len(runs) for runs in long.rounds] == [1, 1]


def test_a_slow_neighbour_does_not_change_the_ratio():
    ticks = count()

    def clock():
        # Every reading comes later than the one before by more and more, as on a machine that gets busier.
        return 1.01 ** next(ticks)

    def contestant(name):
        return Contestant(name, lambda: lambda: np.zeros(1))

    workload = Workload("J", "jobs", (contestant("a"), contestant("b")), (), lambda _: "")
    a, b = race(workload, 20, 0.0, clock, lambda _: None)
    assert b.times[-1] > 1.5 * b.times[0]
    assert median(b.ratios(a)) == pytest.approx(1.0, rel=0.05)


# What is written.


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    console = quiet()
    names = ("w2", "W1", "sampled")
    results = command.bench(names, "2026-01-02T03:04:05+00:00", path, 1, QUICK, console)
    return results, json.loads(path.read_text()), console.file.getvalue()


@pytest.mark.slow
def test_json_holds_every_run(written):
    results, document, _ = written
    assert document["schema"] == "servotwin-bench/1"
    assert document["date"] == "2026-01-02T03:04:05+00:00"
    assert document["quick"] is True
    assert document["machine"]["cores"] >= 1
    assert [workload["name"] for workload in document["workloads"]] == [
        "W1",
        "W2",
        "sampled",
        "counts",
        "calm",
        "quiet",
    ]
    for workload, result in zip(document["workloads"], results, strict=True):
        assert workload["contestants"][0]["ratio"] == 1.0
        for entry, row in zip(workload["contestants"], result.rows, strict=True):
            if "missing" in entry:
                assert entry == {"name": row.name, "missing": row.missing}
                continue
            assert set(entry) == {
                "name",
                "median_s",
                "ratio",
                "ratios",
                "first_s",
                "rounds_s",
                "processor_s",
                "errors",
                "note",
            }
            assert entry["first_s"] > 0.0
            assert all(seconds > 0.0 for runs in entry["rounds_s"] for seconds in runs)
            assert set(entry["errors"]) == set(workload["units"])


def test_the_exact_are_exact_and_the_hold_is_not(written):
    w1 = written[1]["workloads"][0]["contestants"]
    errors = {entry["name"]: entry["errors"]["error"] for entry in w1 if "errors" in entry}
    assert errors["servotwin"] < 1e-11
    assert errors["numba hold 5 kHz"] > 1e-4


def test_tables_name_every_contestant(written):
    results, _, shown = written
    for result in results:
        assert f"{result.workload.name}: {result.workload.title}" in shown
        assert all(row.name in shown for row in result.rows)
    assert "events" in shown
    assert "x real time" in shown


def test_contestants_that_are_missing_are_listed(monkeypatch):
    monkeypatch.setattr(taylor, "MISSING", "not installed (pip install servotwin[bench])")
    console = quiet()
    (result,) = command.bench(["W2"], runs=1, options=QUICK, console=console)
    assert [row.missing for row in result.rows if row.name.startswith("heyoka")] == [taylor.MISSING] * 2
    assert "(pip install servotwin[bench])" in console.file.getvalue()


@pytest.mark.slow
def test_start_runs_in_processes_of_their_own():
    (own, *others) = catalogue.start(QUICK).contestants
    assert own.prepare()().size == 0
    assert others[0].name == "numba hold, cached"
    assert len(catalogue.start(catalogue.Options(slow=True)).contestants) == len(others) + 2


def test_slow_contestants_run_on_request():
    names = [contestant.name for contestant in catalogue.w1(catalogue.Options(quick=True, slow=True)).contestants]
    assert solver.NAME in names
    assert solver.NAME not in [contestant.name for contestant in catalogue.w1(QUICK).contestants]


# Input.


def test_workloads_are_chosen_by_name():
    names = ("W1", "two-mass", "W2", "W3", "sampled", "counts", "calm", "quiet", "decision", "start")
    assert catalogue.chosen([]) == names
    assert catalogue.chosen(["SAMPLED", "w1"]) == ("W1", "sampled", "counts", "calm", "quiet")
    with pytest.raises(
        InvalidInput, match=r"workload 'W9' does not exist.*W3, sampled, counts, calm, quiet, decision, start"
    ):
        catalogue.chosen(["W9"])


def test_a_reference_is_compared_with(tmp_path):
    path = tmp_path / "true.npz"
    np.savez(path, q3=np.zeros(20001))
    (_, check) = catalogue.w1(catalogue.Options(reference=path)).checks
    assert check.of(np.full(1_000_001, 2.0 * UNIT)) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"q": np.zeros(20001)}, "is not an npz file with positions q3"),
        ({"q3": np.zeros((3, 3))}, r"q3 has shape \(3, 3\)"),
        ({"q3": np.zeros(30001)}, "30001 samples, which do not lie on W1's 1000001"),
    ],
)
def test_references_that_do_not_fit_are_refused(tmp_path, arrays, message):
    path = tmp_path / "true.npz"
    np.savez(path, **arrays)
    with pytest.raises(InvalidInput, match=message):
        catalogue.w1(catalogue.Options(reference=path))
    with pytest.raises(InvalidInput, match="leave out --quick"):
        catalogue.w1(catalogue.Options(quick=True, reference=path))


def test_a_missing_or_foreign_reference_is_refused(tmp_path):
    text = tmp_path / "text.npz"
    text.write_text("not an archive")
    for path in (tmp_path / "none.npz", text):
        with pytest.raises(InvalidInput, match="is not an npz file"):
            catalogue.w1(catalogue.Options(reference=path))


def invoke(*arguments):
    return CliRunner().invoke(app, ["bench", *map(str, arguments)])


def test_command_line(tmp_path):
    path = tmp_path / "out.json"
    result = invoke("W1", "--quick", "--runs", 1, "--json", path)
    assert result.exit_code == 0, result.output
    document = json.loads(path.read_text())
    assert len(document["workloads"][0]["contestants"][0]["rounds_s"]) == 1
    assert document["date"].endswith("+00:00")


@pytest.mark.parametrize("arguments", [("W7",), ("W1", "--json", "out.txt"), ("W1", "--reference", "none.npz")])
def test_bad_input_ends_with_one_sentence(arguments):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert result.output.startswith("error: ")
    assert result.output.count("\n") == 1


def test_an_interrupt_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "race", interrupted)
    path = tmp_path / "out.json"
    assert invoke("W1", "--quick", "--json", path).exit_code == 130
    assert not list(tmp_path.iterdir())


def test_the_machine_is_described_without_its_name(tmp_path):
    import platform

    found = report.machine()
    assert {"cpu", "cores", "system", "python", "numpy", "numba"} <= set(found)
    assert platform.node() not in map(str, found.values())
    listing = tmp_path / "cpuinfo"
    listing.write_text("processor : 0\nmodel name : A Processor\nmodel name : A Processor\n")
    assert report._cpu(listing) == "A Processor"
    assert report._cpu(tmp_path / "none")


@pytest.mark.parametrize(("ratio", "text"), [(0.3712, "0.371"), (42.86, "42.9"), (2310.4, "2,310")])
def test_ratios_are_plain_numbers(ratio, text):
    assert command.figure(ratio) == text


@pytest.mark.parametrize(("seconds", "text"), [(0.00123456, "1.23 ms"), (2.5, "2.5 s"), (0.25, "250 ms")])
def test_durations_carry_their_unit(seconds, text):
    assert command.duration(seconds) == text
