"""Standard output on a full disk, or a pipe that its reader has closed: an exit code, and no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from service_system import twin_file
from store_cases import window

from servotwin.store.store import open_store

pytestmark = pytest.mark.slow

SAID = "error: the output could not be written (No space left on device); everything else was done\n"
DIFFERS = """
from servotwin.__main__ import main
import servotwin.cli.replay, sys
servotwin.cli.replay.print_replay = lambda *_: print("differs")
sys.argv = ["servotwin", "replay", "ax-1"]
main()
"""


def ended(words: list[str], output: int, unbuffered: str = "") -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    return subprocess.run(
        [sys.executable, *words], stdout=output, stderr=subprocess.PIPE, text=True, check=False, env=environment
    )


def on_a_full_disk(words: list[str], unbuffered: str = "") -> "subprocess.CompletedProcess[str]":
    with Path("/dev/full").open("w") as full:
        return ended(words, full.fileno(), unbuffered)


def into_a_closed_pipe(words: list[str], unbuffered: str = "") -> "subprocess.CompletedProcess[str]":
    reading, writing = os.pipe()
    os.close(reading)
    try:
        return ended(words, writing, unbuffered)
    finally:
        os.close(writing)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    store = open_store(str(tmp_path / "twin.db"))
    store.put([window("ax-1", n) for n in range(4)])
    store.close()
    return twin_file(tmp_path)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_on_a_full_disk_is_one_sentence_and_a_closed_pipe_none(unbuffered: str) -> None:
    for words in (["--version"], ["tune", "--help"]):
        full = on_a_full_disk(["-m", "servotwin", *words], unbuffered)
        assert (full.returncode, full.stderr) == (2, SAID)
        closed = into_a_closed_pipe(["-m", "servotwin", *words], unbuffered)
        assert (closed.returncode, closed.stderr) == (141, "")


def test_the_help_of_a_command_line_without_a_command_is_output_too() -> None:
    full, closed = on_a_full_disk(["-m", "servotwin"]), into_a_closed_pipe(["-m", "servotwin"])
    assert (full.returncode, full.stderr) == (2, SAID.replace("; everything else was done", ""))
    assert (closed.returncode, closed.stderr) == (141, "")


@pytest.mark.parametrize("words", [["servos"], ["audit", "ax-1", "--json"], ["twin", "check"]])
def test_a_command_whose_output_is_lost_says_so(config: Path, words: list[str]) -> None:
    command = ["-m", "servotwin", *words, "--config", str(config)]
    full, closed = on_a_full_disk(command), into_a_closed_pipe(command)
    assert (full.returncode, full.stderr) == (2, SAID)
    assert (closed.returncode, closed.stderr) == (141, "")


def test_what_was_asked_for_is_done_where_its_output_is_lost(config: Path, tmp_path: Path) -> None:
    for lost, expected in ((on_a_full_disk, (2, SAID)), (into_a_closed_pipe, (141, ""))):
        to = tmp_path / f"{lost.__name__}.db"
        result = lost(["-m", "servotwin", "backup", str(to), "--config", str(config)], "1")
        assert (result.returncode, result.stderr) == expected
        assert to.is_file()
    revoked = on_a_full_disk(["-m", "servotwin", "revoke", "ax-2", "--config", str(config)])
    assert (revoked.returncode, revoked.stderr) == (2, SAID)
    assert "ax-2" not in (tmp_path / "tokens.toml").read_text()


def test_an_estimate_that_differs_is_told_from_output_that_is_lost() -> None:
    full = on_a_full_disk(["-c", DIFFERS])
    assert (full.returncode, full.stderr) == (2, "error: the output could not be written (No space left on device)\n")
    assert ended(["-c", DIFFERS], subprocess.DEVNULL).returncode == 1


def test_an_error_of_the_command_s_own_is_said_alone() -> None:
    for lost in (on_a_full_disk, into_a_closed_pipe):
        result = lost(["-m", "servotwin", "simulate", "nosuch.toml", "-o", "run.csv"])
        assert result.returncode == 2
        assert result.stderr.startswith("error: nosuch.toml")
        assert result.stderr.count("\n") == 1
