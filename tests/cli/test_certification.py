"""`servotwin certify`: tables for the models of a twin's file, or of a scenario."""

from __future__ import annotations

import io
import math
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from servotwin.cli import certify as certification
from servotwin.cli.app import app
from servotwin.cli.certify import GridOptions, certify
from servotwin.errors import InvalidInput
from servotwin.plant.plants import resolve_plant
from servotwin.redesign.certified.lookup import Grid
from servotwin.redesign.registry import certified_policy
from servotwin.twin.model_registry import ModelRegistry
from servotwin.twin.settings import TwinSettings

COARSE = Grid(math.radians(60.0), (1e-2,), (0.0,))
MODEL = """
[models.{name}]
servo = "paper"
[models.{name}.twin]
{table}
"""


def twin_file(folder: Path, *models: tuple[str, str]) -> Path:
    text = "".join(MODEL.format(name=name, table=f'table = "{table}"' if table else "") for name, table in models)
    path = folder / "twin.toml"
    path.write_text(text + '\n[servos]\n"ax-*" = "one"\n', encoding="utf-8")
    return path


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.mark.slow
def test_every_model_that_names_a_table_gets_it_and_the_fleet_takes_it(tmp_path: Path) -> None:
    path = twin_file(tmp_path, ("one", "one.table"), ("other", ""))
    with pytest.raises(
        InvalidInput,
        match=r"table = '.*one\.table': .*one\.table: cannot be read .*`servotwin certify`",
    ):
        ModelRegistry.loads(path.read_text(), "twin.toml", tmp_path)
    console = quiet()
    (table,) = certify(path, grid=COARSE, console=console)
    assert "1 of 1 cells of gaps from 0 to 60 deg are verified" in console.file.getvalue()
    assert "fallback set, for all of them: verified on 300 simulated machines" in console.file.getvalue()
    assert "; not tried: measurement noise" in console.file.getvalue()
    assert len(table.cells) == 1
    assert ModelRegistry.loads(path.read_text(), "twin.toml", tmp_path).models[0].settings.table == str(
        tmp_path / "one.table"
    )


@pytest.mark.slow
def test_cells_whose_command_meets_its_limit_are_verified_too(tmp_path: Path) -> None:
    path = twin_file(tmp_path, ("one", "one.table"))
    path.write_text(path.read_text() + "[models.one.controller]\nvoltage_limit_v = 1.0\n", encoding="utf-8")
    console = quiet()
    (table,) = certify(path, grid=COARSE, console=console)
    assert "1 of 1 cells" in console.file.getvalue()
    (cell,) = table.cells.values()
    assert cell is not None
    assert cell.saturated


@pytest.mark.slow
def test_one_model_may_be_named_and_its_file(tmp_path: Path) -> None:
    path = twin_file(tmp_path, ("one", ""), ("other", ""))
    certify(path, "other", tmp_path / "x.table", COARSE, quiet())
    assert (tmp_path / "x.table").exists()


@pytest.mark.slow
def test_a_scenario_is_accepted_in_place_of_a_twin_s_file(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(
        'servo = "paper"\nduration_s = 50.0\n[reference]\nkind = "square"\namplitude_mm = 1.0\nperiod_s = 40.0\n'
        '[gap]\ntotal_deg = 5.0\n[twin]\ntable = "s.table"\n',
        encoding="utf-8",
    )
    certify(path, grid=COARSE, console=quiet())
    assert (tmp_path / "s.table").exists()


@pytest.mark.parametrize(
    ("models", "options", "why"),
    [
        ((("one", ""),), (None, None), 'no model has a key table = "NAME.table"'),
        ((("one", "a.table"),), ("ore", None), "no such model .did you mean 'one'"),
        ((("one", ""), ("two", "")), (None, Path("x.table")), "has 2 models; choose one with --model"),
    ],
)
def test_a_job_without_anything_to_verify_is_refused(tmp_path: Path, models, options, why: str) -> None:
    with pytest.raises(InvalidInput, match=why):
        certify(twin_file(tmp_path, *models), *options, COARSE, quiet())


def test_a_policy_that_verifies_nothing_is_named(tmp_path: Path) -> None:
    path = tmp_path / "twin.toml"
    path.write_text(
        '[models.one]\nservo = "paper"\n[models.one.twin]\npolicy = "paper"\n[servos]\n"a" = "one"\n', encoding="utf-8"
    )
    with pytest.raises(InvalidInput, match="model 'one': policy 'paper' verifies nothing"):
        certify(path, out=tmp_path / "x.table", grid=COARSE, console=quiet())


def test_a_table_that_no_twin_takes_is_refused_before_anything_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "twin.toml"
    path.write_text('[models.one]\nservo = "two-mass-drive"\n[servos]\n"ax" = "one"\n', encoding="utf-8")
    with pytest.raises(InvalidInput, match=r"x\.table: model 'one': tables hold settings of a filtered PID, .*cascade"):
        certify(path, out=tmp_path / "x.table", console=quiet())
    assert [each.name for each in tmp_path.iterdir()] == ["twin.toml"]


def test_an_interrupt_says_what_is_finished(tmp_path: Path, monkeypatch) -> None:
    def interrupted(*_given):
        yield 3, 8
        raise KeyboardInterrupt

    monkeypatch.setattr("servotwin.cli.certify.build", interrupted)
    with pytest.raises(KeyboardInterrupt, match=r"interrupted: 3 of 8 cells are in .*one\.table; the same command"):
        certify(twin_file(tmp_path, ("one", "one.table")), grid=COARSE, console=quiet())


def test_progress_is_shown_as_lines_where_there_is_no_terminal(tmp_path: Path, monkeypatch) -> None:
    """A table of an axis with friction takes half an hour or more."""
    console = quiet()

    def looked_for(*_given):
        assert console.file.getvalue() == "looking for a verified fallback set\n"
        return table_job(*_given)

    table_job = certification._table_job
    monkeypatch.setattr(certification, "_table_job", looked_for)
    monkeypatch.setattr(certification, "build", lambda *_given: (step for step in [(1, 8), (2, 8)]))
    monkeypatch.setattr(certification, "load", lambda *_given: None)
    monkeypatch.setattr(certification, "_summary", lambda *_given: "written")
    monkeypatch.setattr(certification, "_LINE_EVERY", 0.0)
    certify(twin_file(tmp_path, ("one", "one.table")), grid=COARSE, console=console)
    lines = console.file.getvalue().splitlines()
    assert lines == [lines[0], "verifying one: 1 of 8 cells", "verifying one: 2 of 8 cells", "written"]


def test_the_search_for_a_fallback_set_is_shown(tmp_path: Path, monkeypatch) -> None:
    console = Console(file=io.StringIO(), width=200, force_terminal=True)

    def interrupted(*_given):
        raise KeyboardInterrupt

    monkeypatch.setattr(certification, "_table_job", interrupted)
    with pytest.raises(KeyboardInterrupt):
        certify(twin_file(tmp_path, ("one", "one.table")), grid=COARSE, console=console)
    assert "looking for a verified fallback set" in console.file.getvalue()


@pytest.mark.parametrize(
    ("servo", "options", "why"),
    [
        ("paper", {"finest_deg": -1.0}, "--finest-deg -1 deg: must be finite and above 0"),
        (
            "paper",
            {"finest_at_load": {"finest_at_load_um": 0.0}},
            "--finest-at-load-um 0 µm at the load: must be finite",
        ),
        ("paper", {"biases": {"bias_mv": "x"}}, r"--bias-mv 'x': give VALUE,VALUE,\.\.\. in mV, rising, above 0"),
        ("paper", {"biases": {"bias_mv": "10,1"}}, "--bias-mv '10,1': give .* rising"),
        ("paper", {"biases": {"bias_mv": "0,1"}}, "--bias-mv '0,1': give .* above 0"),
        ("paper", {"noises": {"noise_um": "0,y"}}, r"--noise-um '0,y': give .* in µm, rising, 0 or more"),
        ("paper", {"noises": {"noise_um": "0,nan"}}, "--noise-um '0,nan'"),
        ("robot-joint", {"noises": {"noise_mdeg": "-1"}}, "--noise-mdeg '-1': give .* in mdeg"),
        ("paper", {"noises": {"noise_mdeg": "1"}}, "--noise-mdeg 1: model 'one' has it in µm; give --noise-um"),
        ("paper", {"biases": {"bias_mrad": "1"}}, "--bias-mrad 1: model 'one' has it in mV; give --bias-mv"),
        ("robot-joint", {"noises": {"noise_um": "0"}}, "has it in mdeg; give --noise-mdeg"),
        ("robot-joint", {"biases": {"bias_mv": "1,9"}}, "--bias-mv 1,9: .* has it in mN m; give --bias-mn-m"),
        ("two-mass-drive", {"biases": {"bias_mv": "1"}}, "has it in mN m; give --bias-mn-m"),
        ("telescope", {"noises": {"noise_um": "1"}}, "has it in mdeg; give --noise-mdeg"),
        ("stepper-stage", {"biases": {"bias_mv": "1"}}, "has it in mrad; give --bias-mrad"),
    ],
)
def test_a_grid_is_stated_in_the_units_of_its_model(servo: str, options, why: str) -> None:
    with pytest.raises(InvalidInput, match=why):
        GridOptions(**options).values("one", resolve_plant(servo))


def test_the_units_of_a_grid_are_converted() -> None:
    policy = certified_policy(resolve_plant("robot-joint"), TwinSettings())
    options = GridOptions(2.0, {"bias_mv": None, "bias_mn_m": "5,20"}, {"noise_um": None, "noise_mdeg": "0,90"})
    grid = options.grid("one", policy)
    assert grid.finest == math.radians(2.0)
    options = GridOptions(finest_at_load={"finest_at_load_arcmin": 3.0})
    assert options.grid("one", policy).finest == pytest.approx(math.radians(0.05) / policy.servo.p, rel=1e-14)
    assert grid.biases == pytest.approx((5e-3, 2e-2))
    assert grid.noises == pytest.approx((0.0, math.radians(0.09)))


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("--bias-mv", "give --bias-mn-m"),
        ("--bias-mrad-per-s", "give --bias-mn-m"),
        ("--bias-mrad", "give --bias-mn-m"),
        ("--bias-mn-m", r"in mN m, rising"),
        ("--noise-um", "give --noise-mdeg"),
        ("--noise-mdeg", r"in mdeg, rising"),
    ],
)
def test_every_option_of_the_command_is_checked_before_the_search(
    tmp_path: Path, monkeypatch, option: str, why: str
) -> None:
    monkeypatch.setattr(certification, "certified_policy", lambda *_given: pytest.fail("it takes minutes"))
    path = twin_file(tmp_path, ("one", "one.table"))
    path.write_text(path.read_text().replace('"paper"', '"robot-joint"'), encoding="utf-8")
    shown = CliRunner().invoke(app, ["certify", str(path), option, "2,1"])
    assert shown.exit_code == 2
    assert why in shown.output


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    path = twin_file(tmp_path, ("one", "one.table"))
    coarse = ["--finest-deg", "60", "--bias-mv", "10", "--noise-um", "0"]
    shown = CliRunner().invoke(app, ["certify", str(path), *coarse])
    assert shown.exit_code == 0, shown.output
    assert "1 of 1 cells" in shown.output
    again = CliRunner().invoke(app, ["certify", str(path), "--finest-deg", "30"])
    assert again.exit_code == 2
