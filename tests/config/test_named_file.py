"""A pipe, a socket, a device or a folder in the place of a file that a person names: one sentence, at once."""

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from service_system import twin_file

from servotwin.config.table import read_toml
from servotwin.drives.replay import opened
from servotwin.drives.simulated.machine_state import read_speed, read_state
from servotwin.errors import InvalidInput
from servotwin.link.url import tls_context
from servotwin.logs.log import read_columns
from servotwin.plant.linear_law_file import linear_law
from servotwin.twin_service.auth import read_tokens
from servotwin.twin_service.twin_file import read_twin
from servotwin.up.bulk_enrolment import read_enrolments


def make_socket(path: str) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path)


KINDS = {"a folder": os.mkdir, "a pipe": os.mkfifo, "a socket": make_socket}


@pytest.mark.parametrize("kind", [*KINDS, "a device"])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("any.toml", read_toml),
        ("twin.toml", read_twin),
        ("tokens.toml", read_tokens),
        ("log.csv", lambda path: read_columns(path, ())),
        ("log.csv", opened),
        ("servos.csv", lambda path: read_enrolments(path, None)),
        ("law.npz", lambda path: linear_law(path)),
        ("ca.pem", lambda path: tls_context(str(path))),
        ("state.json", read_state),
        ("speed", read_speed),
    ],
)
def test_what_is_no_file_is_refused_before_it_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, read: Callable[[Path], object], kind: str
) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    path = Path(name)
    if kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        KINDS[kind](name)
    with pytest.raises(InvalidInput, match=rf"{name}: is {kind}; give the name of a file$"):
        read(path)


@pytest.mark.slow
def test_a_command_does_not_wait_for_its_standard_input(tmp_path: Path) -> None:
    """As a process, whose input stays open and tells nothing."""
    twin_file(tmp_path)
    command = [sys.executable, "-m", "servotwin", "twin", "--config", "/dev/stdin"]
    with subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.wait(60) == 2
        assert process.stderr is not None
        assert process.stderr.read() == "error: /dev/stdin: is a pipe; give the name of a file\n"
