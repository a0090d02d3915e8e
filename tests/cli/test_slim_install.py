"""``pip install servotwin`` without extras simulates, estimates and redesigns; a missing package is one sentence."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from servotwin.errors import InvalidInput
from servotwin.runtime.extras import EXTRAS, require

ROOT = Path(__file__).parents[2]
SCENARIO = """
servo = "paper"
duration_s = 4.0
[reference]
kind = "square"
amplitude_mm = 1.0
period_s = 10.0
[gap]
total_deg = 10.0
"""
SLIM = f"""
import json, sys
for name in {sorted(EXTRAS)!r}:
    sys.modules[name] = None
from typer.testing import CliRunner
from servotwin.cli.app import app
found = []
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, arguments)
    found.append([done.exit_code, done.stdout, done.stderr, repr(done.exception)])
print(json.dumps(found))
"""


def slim(folder, *commands):
    """Exit code, standard output, standard error, exception of each command without any extra."""
    done = subprocess.run(
        [sys.executable, "-c", SLIM, json.dumps(commands)], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_optional_package_of_the_table_is_in_its_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for package, extra in EXTRAS.values():
        assert any(one.startswith(package) for one in project["optional-dependencies"][extra]), package
        assert not any(one.startswith(package) for one in project["dependencies"]), package
    everything = project["optional-dependencies"]["all"][0]
    # Readers of formats whose libraries are large, or under the LGPL, are asked for by name.
    assert {extra for _, extra in EXTRAS.values()} - {"mdf", "tdms", "mcap"} <= set(
        everything.partition("[")[2].rstrip("]").split(",")
    )
    assert "servotwin[all]" in project["optional-dependencies"]["dev"]


@pytest.mark.slow
def test_a_slim_install_simulates_estimates_and_redesigns(tmp_path):
    (tmp_path / "wear.toml").write_text(SCENARIO, encoding="utf-8")
    result = slim(
        tmp_path,
        ["--help"],
        *([name, "--help"] for name in ("simulate", "identify", "tune", "certify", "map", "up", "twin", "servos")),
        ["simulate", "wear.toml", "-o", "run.csv"],
        ["identify", "run.csv", "--json"],
        ["tune", "10", "14", "--json"],
        ["limit-cycle", "--json"],
    )
    for code, _, stderr, exception in result:
        assert code == 0, (stderr, exception)
    windows = json.loads(result[-3][1])["windows"]
    assert windows[0]["status"] == "ok"
    assert abs(windows[0]["gap_deg"] - 10.0) < 0.5
    assert json.loads(result[-2][1])["Kp"] > 0.0
    assert json.loads(result[-1][1])["status"] == "limit cycle"


MISSING = {
    "demo": "matplotlib, which is not installed; give: pip install 'servotwin[plot]'",
    "reproduce": "matplotlib, which is not installed; give: pip install 'servotwin[plot]'",
    "map": "joblib, which is not installed; give: pip install 'servotwin[maps]'",
    "twin": "sqlalchemy, which is not installed; give: pip install 'servotwin[twin]'",
    "up": "uvicorn, which is not installed; give: pip install 'servotwin[twin]'",
    "servos": "sqlalchemy, which is not installed; give: pip install 'servotwin[twin]'",
}


@pytest.mark.slow
def test_a_command_without_its_extra_is_one_sentence_and_exit_code_2(tmp_path):
    result = slim(tmp_path, *([name] for name in MISSING))
    for name, (code, stdout, stderr, _) in zip(MISSING, result, strict=True):
        assert code == 2
        assert stdout == ""
        assert stderr == f"error: servotwin {name} needs {MISSING[name]}\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["matplotlib.pyplot", "pandas", "pyarrow"])
def test_a_function_without_its_extra_names_the_pip_command(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    package, extra = EXTRAS[module.partition(".")[0]]
    with pytest.raises(InvalidInput) as refused:
        require(module, "this")
    expected = f"this needs {package}, which is not installed; give: pip install 'servotwin[{extra}]'"
    assert str(refused.value) == expected
