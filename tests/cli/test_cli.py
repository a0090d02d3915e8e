"""The command line: quick to start, one sentence for every user error, exit codes 2 and 130, no traceback."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servotwin.cli import app as cli

SMALL = """
servo = "paper"
duration_s = 2.0
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 5.0
"""


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def run_process(*arguments):
    command = [sys.executable, "-m", "servotwin", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(SMALL)
    return path


def test_help_names_every_command():
    result = run("--help")
    assert result.exit_code == 0
    for name in ("demo", "reproduce", "simulate"):
        assert name in result.output


def test_help_loads_no_numbers_library():
    heavy = "{'numpy', 'scipy', 'numba', 'matplotlib'}"
    code = f"import sys, servotwin.cli.app; print(*sorted({heavy} & set(sys.modules)))"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert completed.stdout.strip() == ""


@pytest.mark.slow
def test_what_only_starts_a_process_imports_no_slow_part_of_scipy():
    """A quarter of the start of each command, each worker and each simulated machine."""
    parts = "{'scipy.stats', 'scipy.signal'}"
    code = f"import sys, servotwin.cli.audit, servotwin.drives.simulated.server; print(*{parts} & set(sys.modules))"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert completed.stdout.strip() == ""


def test_version():
    result = run("--version")
    assert result.exit_code == 0
    assert result.output.startswith("servotwin 0.")
    assert "--no-version" not in run("--help").output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "SCENARIO", "-o", "run.xyz"), "'.xyz'"),
        (("simulate", "SCENARIO", "-o", "nowhere/run.csv"), "no directory nowhere"),
        (("simulate", "missing.toml", "-o", "run.csv"), "missing.toml"),
        (("reproduce", "--only", "fig13"), "fig13"),
        (("reproduce", "--only", "crosover"), "did you mean 'crossover'"),
        (("reproduce", "--only", "fig7", "--preset", "papre"), "papre"),
        (("demo", "--preset", "tabel1"), "tabel1"),
        (("demo", "--out", "SCENARIO/out"), "cannot be made"),
    ],
)
def test_a_user_error_is_one_sentence_and_exit_code_2(scenario, monkeypatch, arguments, message):
    monkeypatch.chdir(scenario.parent)
    result = run(*(argument.replace("SCENARIO", str(scenario)) for argument in arguments))
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
    assert [path.name for path in scenario.parent.iterdir()] == [scenario.name]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--bogus",), "no such option: --bogus"),
        (("mapp",), "no such command 'mapp' (did you mean 'map'?)"),
        (("map", "--worker", "2"), "map: no such option: --worker (did you mean --workers?)"),
        (("map", "paper", "other"), "(other)"),
        (("map", "--members", "many"), "invalid value for '--members'"),
        (("twin", "twin.toml"), "instead of serving (check, test-alarm); the twin's file is given with --config"),
        (("map", "--workers", "0"), "greater than or equal to 1"),
        (("map", "--out"), "'--out' requires an argument"),
        (("simulate",), "simulate: missing argument 'scenario'; see "),
        (("bench", "--run", "1"), "(did you mean --runs?)"),
    ],
)
def test_a_wrong_command_line_is_one_sentence_and_exit_code_2(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
    assert result.stdout == ""


def test_without_arguments_the_help_is_shown():
    result = run()
    assert result.exit_code == 2
    assert "identify" in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("duraton_s = 3.0\n" + SMALL, "duraton_s"),
        (SMALL.replace("5.0", "-5.0"), "total_deg"),
        (SMALL.replace("1.0", "nan"), "size_mm"),
        ("", "empty"),
        ("= what", "TOML"),
    ],
)
def test_a_bad_scenario_is_refused_before_anything_is_written(scenario, change, message):
    scenario.write_text(change)
    result = run("simulate", scenario, "-o", scenario.parent / "run.csv")
    assert result.exit_code == 2
    assert message in result.stderr
    assert scenario.name in result.stderr
    assert [path.name for path in scenario.parent.iterdir()] == [scenario.name]


@pytest.mark.slow
def test_a_process_ends_with_2_and_without_traceback(tmp_path):
    result = run_process("simulate", tmp_path / "no.toml", "-o", tmp_path / "run.csv")
    assert result.returncode == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert result.stderr.startswith("error: ")


def test_an_interrupt_is_130_and_one_line(scenario, monkeypatch):
    monkeypatch.setattr("servotwin.cli.simulate.record", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    result = run("simulate", scenario, "-o", scenario.parent / "run.csv")
    assert result.exit_code == 130
    assert result.stderr.count("\n") == 1


IN_AN_IMPORT = """
import builtins, os, signal
from servotwin.__main__ import main
load = builtins.__import__
def loading(name, *rest, **options):
    if name == "typer":
        os.kill(os.getpid(), signal.SIGINT)
    return load(name, *rest, **options)
builtins.__import__ = loading
main()
"""
WHILE_COMPILING = """
import sys
from servotwin.__main__ import main
import servotwin.cli.simulate
servotwin.cli.simulate.record = lambda *_, **__: exec("raise KeyboardInterrupt")
sys.argv = ["servotwin", "simulate", "scenario.toml", "-o", "run.csv"]
main()
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("program", [IN_AN_IMPORT, WHILE_COMPILING], ids=["in an import", "while compiling"])
def test_a_process_ends_with_130_and_one_line_wherever_it_is_interrupted(tmp_path, program):
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 130
    assert ended.stderr == "interrupted; no partly written file is left\n"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_reproduction_can_be_interrupted(tmp_path):
    """Ctrl-C reaches the whole foreground group: parent and workers."""
    command = [sys.executable, "-m", "servotwin", "reproduce", "--workers", "2", "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    while not (tmp_path / "out").is_dir() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(1.0)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    assert not (tmp_path / "out" / "report.html").exists()
    assert not list((tmp_path / "out").glob(".*"))


def test_the_estimator_s_bench_takes_no_option_that_it_ignores():
    for words in (["W1"], ["--runs", "3"], ["--slow"]):
        result = run("bench", "estimator", *words)
        assert result.exit_code == 2, words


@pytest.mark.slow
def test_an_error_that_cannot_be_written_still_has_its_exit_code() -> None:
    """The log of a twin that starts on a full disk."""
    with Path("/dev/full").open("wb") as full:
        ended = subprocess.run([sys.executable, "-m", "servotwin", "simulate", "nosuch.toml"], stderr=full)
    assert ended.returncode == 2
