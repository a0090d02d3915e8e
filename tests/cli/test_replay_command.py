"""`servotwin replay` on the store of a real twin: the same bit for bit, or the differences, window by window."""

import re
import shutil
import sqlite3
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from lock_step import LockStep
from test_lockstep import SCENARIO, check_deployed_is_simulated, deployed
from typer.testing import CliRunner

from servotwin.cli import app as cli
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import open_store


class Recorded(NamedTuple):
    """The folder of a twin that has worked through a scenario in lock-step, and what it was sent and sent."""

    folder: Path
    scenario: Scenario
    messages: LockStep


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder, twin = tmp_path_factory.mktemp("recorded"), 'policy = "paper"'
    (folder / "scenario.toml").write_text(SCENARIO.format(twin=twin, duration=16.0, period=4.0, fine="false"))
    scenario = Scenario.load(folder / "scenario.toml")
    return Recorded(folder, scenario, deployed(folder, scenario, twin, thread=True))


@pytest.fixture
def folder(recorded: Recorded, tmp_path: Path) -> Path:
    """A copy that may be spoiled."""
    for file in recorded.folder.glob("twin.*"):
        shutil.copy(file, tmp_path)
    return tmp_path


def replayed(folder: Path, *options: str) -> tuple[int, str]:
    """Exit code, and what is printed."""
    result = CliRunner().invoke(cli.app, ["replay", "axis", "--config", str(folder / "twin.toml"), *options])
    return result.exit_code, result.stdout + result.stderr


def changed(folder: Path, statement: str, *values: object) -> int:
    """Rows of the store that a statement changes."""
    with closing(sqlite3.connect(folder / "twin.db")) as database, database:
        return database.execute(statement, values).rowcount


def rows_of(folder: Path, query: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(folder / "twin.db")) as database:
        return database.execute(query).fetchall()


def windows(folder: Path) -> int:
    ((number,),) = rows_of(folder, "select count(*) from messages where kind = 'window'")
    assert isinstance(number, int)
    assert number > 5
    return number


@pytest.mark.slow
def test_deployed_is_simulated_under_the_paper_s_policy(recorded: Recorded) -> None:
    loop = cosimulate(recorded.scenario)
    assert len(loop.updates) >= 2
    check_deployed_is_simulated(loop, recorded.messages, recorded.folder)


@pytest.mark.slow
def test_every_estimate_comes_out_again_bit_for_bit(folder: Path) -> None:
    code, output = replayed(folder)
    assert code == 0
    assert output.split("\n") == [
        f"servo axis: {windows(folder)} windows", f"  {windows(folder):6d} the same, bit for bit", ""
    ]  # fmt: skip


@pytest.mark.slow
def test_a_changed_version_is_named(folder: Path) -> None:
    assert changed(folder, "update contexts set text = replace(text, ?, ?)", f'"{version("numpy")}"', '"1.2.3"') == 1
    code, output = replayed(folder)
    assert code == 0, "the numbers are the same all the same"
    assert f"{windows(folder)} the same, bit for bit" in output
    assert f"changed since {windows(folder)} windows: numpy 1.2.3 then, {version('numpy')} now" in output


@pytest.mark.slow
def test_an_estimate_that_is_not_reproduced_is_reported(folder: Path) -> None:
    """One bit of one stored number: nothing explains that, and nothing else is blamed."""
    (row, body), *_ = rows_of(folder, "select id, body from evidence where kind = 'estimate' and status = 'ok'")
    assert isinstance(body, bytes)
    stored = msgspec.msgpack.decode(body)
    stored["estimate"]["gap"] += 1e-12
    assert changed(folder, "update evidence set body = ? where id = ?", msgspec.msgpack.encode(stored), row) == 1
    code, output = replayed(folder)
    assert code == 1
    assert re.search(
        r"^window .*/\d+: gap .* deg then, .* deg now; changed: gap; no recorded version, .* explains it$", output, re.M
    )
    assert re.search(r"^ +1 NOT the same$", output, re.M)
    assert f"{windows(folder) - 1} the same, bit for bit" in output


@pytest.mark.slow
def test_a_changed_model_is_named_with_its_changes(folder: Path) -> None:
    code, _ = replayed(folder, "--present")
    assert code == 0
    twin = folder / "twin.toml"
    twin.write_text(twin.read_text().replace('policy = "paper"', 'policy = "paper"\nmethod = "paper"'))
    code, output = replayed(folder, "--present")
    assert code == 1
    assert f"changed since {windows(folder)} windows: settings.method 'whitened' then, 'paper' now" in output
    assert replayed(folder)[0] == 0, "as they were then"


@pytest.mark.slow
def test_windows_that_retention_emptied_are_counted_and_the_rest_is_compared(folder: Path) -> None:
    store = open_store(f"sqlite:///{folder / 'twin.db'}")
    try:
        gone = delete_old_bodies(store, 10**9)
    finally:
        store.close()
    assert gone.emptied > 0
    assert gone.retained > 0
    code, output = replayed(folder)
    assert code == 0
    assert f"{gone.emptied} not repeated: retention deleted the window's body" in output
    assert f"{gone.retained} the same, bit for bit" in output


@pytest.mark.slow
def test_one_window_is_enough(folder: Path) -> None:
    name = rows_of(folder, "select key from messages where kind = 'window'")[2][0]
    assert isinstance(name, str)
    code, output = replayed(folder, "--window", name)
    assert (code, output.splitlines()[0]) == (0, "servo axis: 1 window")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statement", "output"),
    [
        ("update contexts set text = '{}'", "settings are not understood"),
        ("update contexts set text = 'x'", "the context is not understood"),
        ("update bodies set body = x'00'", "cannot be decompressed|not understood"),
        ("update evidence set body = x'00' where kind = 'estimate'", "the stored estimate is not understood"),
    ],
)
def test_data_that_cannot_be_decoded_is_reported_for_each_window(folder: Path, statement: str, output: str) -> None:
    assert changed(folder, statement) > 0
    code, result = replayed(folder)
    assert code == 1
    assert "NOT repeated: the stored data cannot be decoded" in result
    assert re.search(output, result), result
    assert "Traceback" not in result


@pytest.mark.slow
def test_windows_that_were_never_estimated_are_counted_apart(folder: Path) -> None:
    assert changed(folder, "update evidence set status = 'failed: a reason' where kind = 'estimate'") == windows(folder)
    code, output = replayed(folder)
    assert (code, output.splitlines()[1].strip()) == (
        0,
        f"{windows(folder)} not estimated: the window could not be processed",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (("--window", "never/1"), "error: servo 'axis': no window never/1 of it was ever stored\n"),
        (("--window", "never"), "error: window 'never': give BOOT/NUMBER, as `servotwin audit` shows it\n"),
    ],
)
def test_an_invalid_window_is_one_sentence(folder: Path, arguments: tuple[str, ...], output: str) -> None:
    assert replayed(folder, *arguments) == (2, output)


@pytest.mark.slow
def test_reading_makes_no_store(folder: Path) -> None:
    for file in folder.glob("twin.db*"):
        file.unlink()
    code, output = replayed(folder)
    assert code == 2
    assert output.endswith("there is no such file; the twin makes it when it first runs\n")
    assert not (folder / "twin.db").exists()
