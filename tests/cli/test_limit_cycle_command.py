"""`servotwin limit-cycle`: its output and its errors."""

import json

import pytest
from typer.testing import CliRunner

from servotwin.cli import app as cli


def run(*arguments):
    return CliRunner().invoke(cli.app, ["limit-cycle", *map(str, arguments)])


def test_the_table_holds_orbit_and_prediction():
    result = run()
    assert result.exit_code == 0
    for message in ("1.480016437", "0.179574564", "0.5853, 0.5513, 0.5513", "1.4335", "22.26", "stable"):
        assert message in result.output


def test_the_same_as_json():
    found = json.loads(run("table1", "--gap-deg", 20, "--json").output)
    assert found["status"] == "limit cycle"
    assert found["orbit"]["frequency_hz"] == pytest.approx(0.910227448140, abs=1e-12)
    assert found["orbit"]["amplitude_mm"] == pytest.approx(2 * 0.054039772707, rel=1e-11)
    (prediction,) = found["describing_function"]
    assert prediction["orbit"]["frequency_hz"] == pytest.approx(0.910227448140, abs=1e-10)
    assert found["no_prediction"] == ""


def test_a_dead_zone_that_settles_the_loop():
    result = run("--tolerance-mm", 0.06)
    assert result.exit_code == 0
    assert "settles" in result.output
    assert "second nonlinearity" in result.output


def test_hysteresis_is_passed_on():
    plain, wide = (json.loads(run("--tolerance-mm", 0.03, "--json", *more).output) for more in ((), ("--leave", 1.5)))
    assert plain != wide


def test_a_describing_function_that_predicts_nothing_is_said() -> None:
    shown = run("stepper-stage").output
    assert "no prediction by the describing function: it predicts no limit cycle" in " ".join(shown.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("papre",), "papre"),
        (("--gap-deg", -1), "--gap-deg -1 deg: must be from 0 to 360, one turn"),
        (("telescope", "--gap-deg", 1e7), "--gap-deg 1e+07 deg: must be from 0 to"),
        (("--gap-deg", "nan"), "--gap-deg nan deg: must be from 0 to 360, one turn"),
        (("--step-mm", 0), "--step-mm 0 mm: must be finite and not 0"),
        (("telescope", "--step-deg", 0), "--step-deg 0 deg: must be finite and not 0"),
        (("telescope", "--step-deg", "inf"), "--step-deg inf deg: must be finite and not 0"),
        (("--tolerance-mm", -1), "--tolerance-mm -1 mm: must be finite and 0 or more"),
        (("telescope", "--tolerance-deg", -1), "--tolerance-deg -1 deg: must be finite and 0 or more"),
        (("telescope", "--step-mm", 2), "--step-mm 2: telescope has it in deg; give --step-deg"),
        (("gantry", "--tolerance-deg", 2), "--tolerance-deg 2: gantry has it in mm; give --tolerance-mm"),
        (("--tolerance-mm", 1, "--enter", 2), "leave = 1.0 tolerances"),
    ],
)
def test_a_user_error_is_one_sentence_and_exit_code_2(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
