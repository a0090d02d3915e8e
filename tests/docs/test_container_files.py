"""The container files: what they run is run here, in other folders; users and paths are those of the systemd units."""

import json
import re
import shutil
import signal
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
import yaml
from mosquitto import free_port
from selfsigned import self_made
from servers import needed
from service_system import twin_file

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs/operator/container"
CONTAINERFILE = (FOLDER / "Containerfile").read_text()
COMPOSE: Any = yaml.safe_load((FOLDER / "compose.yaml").read_text())
UNITS = {
    "twin": (ROOT / "docs/operator/systemd/servotwin-twin.service").read_text(),
    "edge": (ROOT / "docs/operator/systemd/servotwin-edge@.service").read_text(),
}


def stage(name: str) -> dict[str, list[str]]:
    """Instructions of a stage, their arguments."""
    [text] = re.findall(rf"^FROM \S+ AS {name}\n(.*?)(?=^FROM |\Z)", CONTAINERFILE, re.MULTILINE | re.DOTALL)
    found: dict[str, list[str]] = {}
    for line in re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines():
        if line.strip():
            word, _, rest = line.partition(" ")
            found.setdefault(word, []).append(rest.strip())
    return found


def command(name: str) -> list[str]:
    """The command of an image, with this Python."""
    parts = stage(name)
    return here([*json.loads(parts["ENTRYPOINT"][0]), *json.loads(parts["CMD"][0])])


def here(line: list[str]) -> list[str]:
    program, *rest = line
    own = {"/opt/servotwin/bin/servotwin": [sys.executable, "-m", "servotwin"]}
    return [*own.get(program, [sys.executable] if re.fullmatch(r"/opt/\S+/bin/python", program) else [program]), *rest]


@pytest.mark.parametrize("name", ["twin", "edge"])
def test_an_image_has_the_user_the_folder_and_the_command_of_the_unit(name: str) -> None:
    parts, unit = stage(name), UNITS[name]
    [user], [folder] = parts["USER"], parts["WORKDIR"]
    assert f"\nUser={user}\n" in unit
    assert folder == re.findall(r"^WorkingDirectory=([^%\s]+?)(?:/%i)?$", unit, re.MULTILINE)[0]
    assert " ".join([*json.loads(parts["ENTRYPOINT"][0]), *json.loads(parts["CMD"][0])]) in unit
    made, *rest = parts["RUN"]
    assert re.search(rf"useradd --system --uid \d+ --home-dir {folder} .* {user} ", made)
    assert f"install -d -o {user} -m 0700 {folder}" in made
    assert f"-m venv {Path(json.loads(parts['ENTRYPOINT'][0])[0]).parents[1]}" in rest[0]
    for variable, value in re.findall(r"(\w+_DIR)=(\S+)", parts["ENV"][0]):
        assert f"Environment={variable}={value}" in unit
        assert value in made
    assert f"KillSignal={parts['STOPSIGNAL'][0]}" in unit or "KillSignal" not in unit


def test_what_is_copied_and_installed_exists() -> None:
    for names in stage("source")["COPY"]:
        *sources, _ = names.split()
        assert all((ROOT / each).exists() for each in sources)
    project = (ROOT / "pyproject.toml").read_text()
    for extras in re.findall(r"/source\[([\w,]+)\]", CONTAINERFILE):
        assert all(re.search(rf"^{each} = \[", project, re.MULTILINE) for each in extras.split(","))


def ignored(path: str) -> bool:
    """True for a path that is not sent to the builder; each rule of .dockerignore is for names, the last one counts."""
    found = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        pattern, parts = line.removeprefix("!"), path.split("/")
        anywhere = pattern.startswith("**/")
        if any(fnmatchcase(part, pattern.removeprefix("**/")) for part in (parts if anywhere else parts[:1])):
            found = not line.startswith("!")
    return found


def test_only_what_the_images_are_made_of_is_sent_to_the_builder() -> None:
    copied = {each for names in stage("source")["COPY"] for each in names.split()[:-1]}
    here = {each.name for each in ROOT.iterdir()} | {".git", ".venv", ".mypy_cache", "twin.db"}
    assert {name for name in here if not ignored(name)} == copied
    package = [path.relative_to(ROOT) for path in (ROOT / "servotwin").rglob("*") if path.is_file()]
    for path in [*package, Path("servotwin/cli/__pycache__/app.cpython-312.pyc")]:
        assert ignored(str(path)) == ("__pycache__" in path.parts)


def test_the_services_run_the_images_with_little_rights_and_their_folders() -> None:
    twin, edge = COMPOSE["services"]["twin"], COMPOSE["services"]["edge-ax-1"]
    for service, name in ((twin, "twin"), (edge, "edge")):
        parts = stage(name)
        assert f"--target {name} -t {service['image']} " in CONTAINERFILE
        assert parts["WORKDIR"][0] in [each.split(":")[1] for each in service["volumes"]]
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        [timeout] = re.findall(r"^TimeoutStopSec=(\d+)", UNITS[name], re.MULTILINE)
        assert service["stop_grace_period"] == f"{timeout}s"
        text = (FOLDER / "compose.yaml").read_text()
        [uid] = re.findall(r"--uid (\d+)", parts["RUN"][0])
        assert f"chown -R {uid} {service['volumes'][0].split(':')[0][2:]}" in text
    assert twin["ports"] == [f"{stage('twin')['EXPOSE'][0]}:8765"]
    assert {each.split(":")[1] for each in twin["volumes"]} >= set(re.findall(r"_DIR=(\S+)", stage("twin")["ENV"][0]))


@pytest.mark.slow
def test_compose_takes_its_file(tmp_path: Path) -> None:
    compose = needed("docker-compose")
    shutil.copy(FOLDER / "compose.yaml", tmp_path)
    done = subprocess.run([compose, "config", "-q"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_twin_s_command_is_healthy_and_ends_at_its_signal(tmp_path: Path) -> None:
    self_made(tmp_path)
    port, parts = free_port(), stage("twin")
    tls = 'bind = "0.0.0.0"\ntls_certificate = "made.crt"\ntls_key = "made.key"'
    path = twin_file(tmp_path, tls)
    path.write_text(path.read_text().replace("port = 0", f"port = {port}"))
    check = json.loads(parts["HEALTHCHECK"][0].partition("CMD ")[2])
    assert check[0] == json.loads(parts["ENTRYPOINT"][0])[0].replace("bin/servotwin", "bin/python")
    check = [each.replace(":8765/", f":{port}/") for each in here(check)]
    assert subprocess.run(check, capture_output=True, check=False).returncode != 0
    with (tmp_path / "log").open("w") as log:
        running = subprocess.Popen(command("twin"), cwd=tmp_path, stdout=subprocess.PIPE, stderr=log, text=True)
    try:
        assert running.stdout is not None
        assert "listening on https://0.0.0.0" in running.stdout.readline()
        done = subprocess.run(check, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        running.send_signal(getattr(signal, parts["STOPSIGNAL"][0]))
        assert running.wait(60.0) == 0
    finally:
        running.kill()
        running.communicate()


def test_the_edge_s_command_begins_with_its_file(tmp_path: Path) -> None:
    done = subprocess.run(command("edge"), cwd=tmp_path, capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == 2
    assert "edge.toml" in done.stderr
    assert done.stderr.count("\n") == 1
