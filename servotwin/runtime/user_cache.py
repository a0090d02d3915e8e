"""Folder of the user's for what is costly to compute and may be lost, and a digest of the code that computed it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import servotwin

VARIABLE = "SERVOTWIN_CACHE_DIR"
"""Environment variable that names another folder; empty: nothing is written or read."""


def cache_folder() -> Path | None:
    """Return servotwin's folder in the user's cache folder, which need not exist; None: there is none.

    It is `SERVOTWIN_CACHE_DIR`, otherwise `servotwin` in `XDG_CACHE_HOME` or in `~/.cache`.
    """
    given = os.environ.get(VARIABLE)
    if given is not None:
        return Path(given).absolute() if given else None
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification of the XDG folders: a relative path is to be ignored.
    if base and Path(base).is_absolute():
        return Path(base, "servotwin")
    try:
        return Path.home() / ".cache" / "servotwin"
    except RuntimeError:  # a user without a home, as under a service manager
        return None


def source_digest() -> str:
    """Return the SHA-256 of the package's source code: names and contents of all its Python files."""
    return digest_of(Path(servotwin.__file__).parent)


@cache
def digest_of(folder: Path) -> str:
    """Return the SHA-256 of the Python files in a folder and below, once a process."""
    digest = hashlib.sha256()
    for path in _python_files(folder):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def _python_files(folder: Path) -> Iterable[Path]:
    for root, folders, names in os.walk(folder):
        # In place: os.walk goes on with these. The cache of compiled code has many files.
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        yield from (Path(root, name) for name in sorted(names) if name.endswith(".py"))
