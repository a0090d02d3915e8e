"""A lock holds one process at a time, and ends with it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from servotwin.runtime.locks import lock_beside, locked

HOLD = """
import pathlib, sys
from servotwin.runtime.locks import locked
with locked(pathlib.Path(sys.argv[1])):
    print("locked", flush=True)
    input()
"""


def test_a_lock_is_held_until_its_process_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "file-lock"
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"locked\n"
        with pytest.raises(BlockingIOError), locked(path):
            pass
        holder.kill()
    with locked(path, wait=True) as descriptor:
        assert os.fstat(descriptor).st_mode & 0o777 == 0o600


def test_a_lock_is_released_after_the_block(tmp_path: Path) -> None:
    path = tmp_path / "file-lock"
    with locked(path), pytest.raises(BlockingIOError), locked(path):
        pass
    with locked(path) as descriptor:
        assert os.fstat(descriptor).st_ino == path.stat().st_ino


def test_the_lock_lies_beside_the_file_that_a_link_leads_to(tmp_path: Path) -> None:
    (tmp_path / "real.db").touch()
    (tmp_path / "link.db").symlink_to(tmp_path / "real.db")
    assert lock_beside(tmp_path / "link.db") == (tmp_path / "real.db-lock").resolve()
