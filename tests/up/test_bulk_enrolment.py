"""Enrolling many servos from a CSV file: all or none."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from service_system import twin_file
from typer.testing import CliRunner

from servotwin.cli import app as cli
from servotwin.edge_process.config import token_of
from servotwin.edge_process.config_file import load
from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.store.store import open_store
from servotwin.twin_service.auth import Verifiers, read_tokens, tokens_locked, write_tokens
from servotwin.twin_service.command import check_fleet
from servotwin.up import bulk_enrolment, enrolment

URL = "https://twin:1"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    twin_file(tmp_path, 'tokens = "tokens.toml"', tokens=False)
    write_tokens(tmp_path / "tokens.toml", Verifiers({"ax-old": b"\1" * 32}, {"me": b"\2" * 32}))
    return tmp_path


def enroll(folder: Path, rows: str, *options: str) -> tuple[int, str, str]:
    (folder / "fleet.csv").write_text(rows)
    arguments = ["enroll", "--csv", folder / "fleet.csv", "--twin", folder / "twin.toml", *options]
    done = CliRunner().invoke(cli.app, [str(each) for each in arguments])
    return done.exit_code, done.stdout, done.stderr


def files(folder: Path) -> set[str]:
    """Everything but the lock and the CSV itself."""
    found = {str(path.relative_to(folder)) for path in folder.rglob("*")}
    return {name for name in found if "lock" not in name and name != "fleet.csv"}


def test_each_row_enrolls_a_servo_with_what_it_says_and_the_options_for_the_rest(folder: Path) -> None:
    (folder / "opcua.toml").write_text('[drive]\nkind = "opcua"\nurl = "opc.tcp://plc"\n')
    rows = (
        "\ufeffname,edge,role,noise_um,sample_rate_hz,drive,url\r\n"
        "ax-1,,control,5,1000,,\r\n\r\n"
        '"ax-2", hall 3/two ,,,,opcua.toml,https://other:2\r\n'
    )
    code, said, error = enroll(folder, rows, "--url", URL)
    assert (code, error) == (0, "")
    first, second = load(folder / "ax-1/edge.toml"), load(folder / "hall 3/two/edge.toml")
    assert first.twin is not None
    assert second.twin is not None
    assert (first.role, first.agent.sample_rate, first.twin.url) == ("control", 1000.0, URL)
    assert (second.role, second.agent.sample_rate, second.drive["kind"]) == ("supervise", 5000.0, "opcua")
    assert (second.agent.servo, second.twin.url) == ("ax-2", "https://other:2")
    tokens = {name: token_of(each) for name, each in (("ax-1", first), ("ax-2", second))}
    known = read_tokens(folder / "tokens.toml")
    assert known.servos == {"ax-old": b"\1" * 32, **{name: verifier_of(token) for name, token in tokens.items()}}
    assert known.operators == {"me": b"\2" * 32}
    assert not any(token in said for token in tokens.values())


def test_bad_rows_are_each_named_with_their_line_and_nothing_is_written(folder: Path) -> None:
    before, tokens = files(folder), (folder / "tokens.toml").read_bytes()
    rows = (
        "name,role,sample_rate_hz,edge\nax-1,control,1000,\nax-3,,fast,\nax-1,,,two\n"
        ",control,,\nax-4,control\nax-5,,,ax-1\n"
    )
    code, said, error = enroll(folder, rows, "--url", URL)
    assert (code, said) == (2, "")
    named = {"'ax-1': line 2": 4, "no name": 5, "2 cells": 6, "line 2 has that folder": 7}
    for fault, line in named.items():
        assert any(f"line {line}: " in each and fault in each for each in error.splitlines()), (fault, error)
    assert "line 3: sample_rate_hz = 'fast': give a number above 0, in Hz" in error
    assert (files(folder), (folder / "tokens.toml").read_bytes()) == (before, tokens)
    rows = "name,role\nax-1,control\nax-2,guess\nstranger,\nax-old,\nax 6,\n"
    code, said, error = enroll(folder, rows, "--url", URL)
    assert (code, said) == (2, "")
    for line, fault in {3: "guess", 4: "stranger", 5: "--again", 6: "'ax 6'"}.items():
        assert any(f"line {line}: " in each and fault in each for each in error.splitlines()), (line, error)
    assert "line 2:" not in error
    assert "4 rows" in error
    code, said, error = enroll(folder, "name,edge\nax-1,a\0b\n", "--url", URL)
    assert (code, said) == (2, "")
    assert "line 2: edge = 'a\\x00b': has a zero byte" in error
    rows = f"name,edge,sample_rate_hz\nax-2,{'x' * 300},\nax-3,twin.toml/x,\nax-4,,0.5\nax-5,,1e-300\n"
    code, said, error = enroll(folder, rows, "--url", URL)
    assert (code, said) == (2, "")
    for line, each in enumerate(("name too long", "Not a directory", "has no sample", "has no sample"), 2):
        assert any(f"line {line}: " in one and each in one for one in error.splitlines()), (line, error)
    assert (files(folder), (folder / "tokens.toml").read_bytes()) == (before, tokens)


def test_a_cell_of_any_length_is_quoted_in_part(folder: Path) -> None:
    long = "x" * 5000
    for rows in (
        f"name\n{long}\n{long}\n",
        f"name,{long}\nax-3,\n",
        f"name,role,noise_um\nax-3,{long},\nax-4,,{long}\n",
    ):
        code, said, error = enroll(folder, rows, "--url", URL)
        assert (code, said) == (2, "")
        assert "x" * 80 in error
        assert "x" * 81 not in error


def test_a_folder_that_cannot_be_written_leaves_all_as_it_was(folder: Path) -> None:
    assert enroll(folder, "name\nax-1\n", "--url", URL)[0] == 0
    (folder / "file").write_text("")
    before, tokens = files(folder), (folder / "tokens.toml").read_bytes()
    token = (folder / "ax-1/token").read_bytes()
    code, _, error = enroll(folder, "name,edge\nax-1,\nax-2,new/deep/x\nax-3,file/ax-3\n", "--url", URL, "--again")
    assert code == 2
    assert "line 4: " in error
    assert "file/ax-3" in error
    assert (files(folder), (folder / "tokens.toml").read_bytes()) == (before, tokens)
    assert (folder / "ax-1/token").read_bytes() == token


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ("", "'name' is missing"),
        ("ax-1\n", "column 'ax-1' is not known"),
        ("name;role\nax-1;control\n", "line 1: separates its columns by semicolons or tabs; separate them by commas"),
        ("name,name\nax-1,ax-1\n", "named twice"),
        ("name,rolle\nax-1,\n", "did you mean 'role'"),
        ("name\n\n", "has no rows"),
        ('name\n"ax-1\n', "cannot be read as CSV"),
    ],
)
def test_a_file_that_is_no_list_of_servos_is_one_sentence(folder: Path, rows: str, fault: str) -> None:
    code, _, error = enroll(folder, rows, "--url", URL)
    assert code == 2
    assert fault in error
    assert error.count("\n") == 1


def test_no_window_of_an_enrolled_edge_is_longer_than_its_twin_takes(folder: Path) -> None:
    assert enroll(folder, "name,sample_rate_hz\nax-1,200000\n", "--url", URL)[0] == 0
    agent = load(folder / "ax-1/edge.toml").agent
    assert agent.window_samples < agent.longest_samples == 250_000
    twin_file(folder, 'samples_per_window = 100\ntokens = "tokens.toml"', tokens=False)
    code, _, error = enroll(folder, "name\nax-2\n", "--url", URL)
    assert code == 2
    assert "line 2: window = 1.0 s: has 5000 samples at 5000.0 Hz; the twin takes at most samples_per_window" in error


def test_a_name_and_a_file_exclude_each_other(folder: Path) -> None:
    for arguments in (["enroll"], ["enroll", "ax-1", "--csv", "fleet.csv"]):
        done = CliRunner().invoke(cli.app, arguments)
        assert (done.exit_code, done.stderr.count("give a name, or --csv")) == (2, 1)


@pytest.mark.slow
def test_a_store_of_another_fleet_is_refused_in_one_sentence(folder: Path) -> None:
    """Its servos may have the same names: updates of these machines would follow from the past of those."""
    for name in ("a", "b"):
        (folder / name).mkdir()
        twin_file(folder / name, 'tokens = "tokens.toml"', tokens=False)
        assert enroll(folder / name, "name\nax-1\n", "--url", URL)[0] == 0
    here, other = ((folder / name / "tokens.toml") for name in ("a", "b"))
    with closing(open_store(f"sqlite:///{folder}/a/twin.db")) as store:
        check_fleet(store, None)
        check_fleet(store, here)
        assert enroll(folder / "a", "name\nax-2\n", "--url", URL)[0] == 0  # the file was written again
        check_fleet(store, here)
        with pytest.raises(InvalidInput) as refused:
            check_fleet(store, other)
        own, foreign = read_tokens(here).fleet, read_tokens(other).fleet
        assert f"belongs to the fleet {own!r}" in str(refused.value)
        other.write_text(other.read_text().replace(foreign, own))
        check_fleet(store, other)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_leaves_all_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Also where it comes twice, as `timeout` and a closed terminal send it."""
    kept = files(folder)
    write, contents = enrolment.write_private, (folder / "tokens.toml").read_bytes()

    def interrupted(path: Path, *others: Any) -> None:
        write(path, *others)
        if path.parent.name == "ax-2":
            os.kill(os.getpid(), number)

    def again(*others: Any) -> None:
        os.kill(os.getpid(), number)
        put_back(*others)

    put_back = bulk_enrolment._put_back
    monkeypatch.setattr(enrolment, "write_private", interrupted)
    monkeypatch.setattr(bulk_enrolment, "_put_back", again)
    former = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)}
    for each in former:
        signal.signal(each, signal.default_int_handler)  # the test must not end
    try:
        code, said, error = enroll(folder, "name\nax-1\nax-2\nax-3\n", "--url", URL)
    finally:
        for each, handler in former.items():
            signal.signal(each, handler)
    assert (code, said, error) == (128 + number, "", "interrupted; no partly written file is left\n")
    assert files(folder) == kept
    assert (folder / "tokens.toml").read_bytes() == contents


def test_what_rows_have_in_common_is_computed_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, make = list[str](), enrolment._edge_config
    monkeypatch.setattr(enrolment, "_edge_config", lambda *given: made.append("") or make(*given))
    rows = "name,noise_um\n" + "".join(f"ax-{each},{each % 2}\n" for each in range(10))
    assert enroll(folder, rows, "--url", URL)[0] == 0
    assert len(made) == 2
    assert enroll(folder, "name,edge\nax-odd,one\n", "--url", URL, "--noise-um", "1")[0] == 0
    texts = [(folder / name / "edge.toml").read_text() for name in ("ax-3", "one")]
    assert texts[0].replace('"ax-3"', '"ax-odd"') == texts[1]


def test_a_name_that_was_enrolled_meanwhile_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are checked before the file of tokens is locked, and once more with the lock."""
    monkeypatch.setattr(bulk_enrolment, "present_tokens", lambda _twin: Verifiers())
    code, _, error = enroll(folder, "name\nax-1\nax-old\n", "--url", URL)
    assert code == 2
    assert "line 3: 'ax-old' has a token already" in error
    assert not (folder / "ax-1").exists()


@pytest.mark.slow
def test_whoever_waits_for_the_file_of_tokens_says_so(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with ThreadPoolExecutor(1) as other:
        with tokens_locked(folder / "tokens.toml"):
            revoked = other.submit(enrolment.revoke, folder / "twin.toml", "me")
            time.sleep(1.5)
            assert not revoked.done()
        revoked.result()
    said = f"{folder}/tokens.toml: locked by process {os.getpid()}, an enrolment or revocation; waiting for its end\n"
    assert capfd.readouterr().err == said
    assert not read_tokens(folder / "tokens.toml").operators
