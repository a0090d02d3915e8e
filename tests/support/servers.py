"""Programs that tests start, from PATH or Debian packages; a missing one skips the test, or fails it in CI as root."""

import os
import shutil
from pathlib import Path

import pytest

PLACES = {"mosquitto": "/usr/sbin", "initdb": "/usr/lib/postgresql/*/bin", "pg_ctl": "/usr/lib/postgresql/*/bin"}


def find(program: str) -> Path | None:
    """Path of a program, from PATH or of its Debian package; None: it is missing."""
    known = shutil.which(program)
    if known is not None:
        return Path(known)
    folder = PLACES.get(program, "/usr/sbin")
    return max(Path("/").glob(f"{folder.lstrip('/')}/{program}"), default=None)


def needed(program: str) -> Path:
    """Path of a program; without it the test is skipped, or fails where `tests/packages.sh` must have installed it."""
    path = find(program)
    if path is None:
        must = bool(os.environ.get("CI")) and os.geteuid() == 0
        (pytest.fail if must else pytest.skip)(f"{program} is not installed: tests/packages.sh installs it")
    return path
