"""Names in the documentation exist, its links lead somewhere, and its samples run."""

import ast
import dataclasses
import pkgutil
import re
import tomllib
from pathlib import Path

import pytest

import servotwin as st
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge_process import config_file as edge_config_file
from servotwin.reproduction.report import errata
from servotwin.twin_service.twin_file import read_twin

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")], key=str)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"`((?:servotwin|benchmarks)(?:\.\w+)+)`")
FILE = re.compile(r"`((?:servotwin|tests|docs|benchmarks)/[\w./-]+\.\w+)(?:::(\w+))?`")

LOADERS = {
    "actuator": st.Axis.from_file,
    "motor": st.Servo.load,
    "listen": MachineSettings.load,
    "drive": edge_config_file.load,
    "models": read_twin,
}
"""By a key that only files of this sort have; any other is a scenario."""


def label(value):
    return str(value.relative_to(ROOT)) if isinstance(value, Path) else None


def blocks(language):
    return [
        pytest.param(match[2], id=f"{page.relative_to(ROOT)}:{page.read_text()[: match.start()].count(chr(10)) + 1}")
        for page in PAGES
        for match in BLOCK.finditer(page.read_text())
        if match[1] == language
    ]


def functions(path):
    tree = ast.parse(path.read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_links_lead_somewhere(page):
    links = [link.partition("#")[0] for link in LINK.findall(page.read_text())]
    local = [link for link in links if link and not link.startswith(("https://", "http://", "mailto:"))]
    assert not [link for link in local if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_named_objects_exist(page):
    for name in NAME.findall(page.read_text()):
        assert pkgutil.resolve_name(name) is not None, name


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=label)
def test_named_files_and_tests_exist(page):
    for name, function in FILE.findall(page.read_text()):
        assert (ROOT / name).is_file(), name
        assert not function or function in functions(ROOT / name), f"{name}::{function}"


def test_every_erratum_that_is_referred_to_is_listed():
    """One numbering under one name: `erratum E5` in code, scenarios, tests and pages is entry E5 of errata.toml."""
    folders = ("servotwin", "tests", "benchmarks", "docs")
    files = [
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in {".py", ".toml", ".md"}
    ]
    named = {name for path in files for name in re.findall(r"\b(?:[Ee]rratum|[Ee]rrata) (E\d+)", path.read_text())}
    assert len(named) > 10
    assert named <= {entry["id"] for entry in errata()}


def test_every_page_is_reached_from_the_index():
    reached = {(ROOT / "docs" / link).resolve() for link in LINK.findall((ROOT / "docs/index.md").read_text())}
    assert not [page for page in PAGES if page.parent != ROOT and page.name != "index.md" and page not in reached]


@pytest.mark.slow
@pytest.mark.parametrize("code", blocks("python"))
def test_python_samples_run(code, tmp_path, monkeypatch, capsys):
    """To the end: everything that they print is there."""
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "sample", "exec"), {"__name__": "sample"})
    assert len(capsys.readouterr().out.splitlines()) >= code.count("print(")


@pytest.mark.slow
@pytest.mark.parametrize("text", blocks("toml"))
def test_toml_samples_load(text, tmp_path):
    file = tmp_path / "sample.toml"
    values = tomllib.loads(text)
    if set(values) == {"controller"}:  # of the axis that the text names
        text = st.Axis.preset("two-mass-drive").dumps().partition("[controller]")[0] + text
        values = tomllib.loads(text)
    file.write_text(text)
    load = next((load for key, load in LOADERS.items() if key in values), st.Scenario.load)
    sample = load(file)
    assert dataclasses.replace(sample) == sample


@pytest.mark.parametrize("text", blocks("sh"))
def test_shell_samples_name_commands_that_exist(text):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in filter(None, text.splitlines()):
        program, command, *_ = line.split()
        assert program in {"make", "servotwin"}
        assert command in (targets if program == "make" else commands())


def commands():
    from servotwin.cli.app import app

    return {entry.name or entry.callback.__name__ for entry in app.registered_commands}


def test_no_two_public_classes_share_a_name():
    names: dict[str, list[str]] = {}
    for path in sorted((ROOT / "servotwin").rglob("*.py")):
        for line in path.read_text(encoding="utf-8").splitlines():
            if match := re.match(r"class ([A-Z]\w*)", line):
                names.setdefault(match[1], []).append(str(path.relative_to(ROOT)))
    assert {name: files for name, files in names.items() if len(files) > 1} == {}
