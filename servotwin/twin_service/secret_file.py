"""Files that only their owner may read."""

from __future__ import annotations

import stat
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.runtime.files import replace_file

PRIVATE = 0o600


def read_secret(path: Path) -> str:
    """What a private file holds, without space around it.

    Raises
    ------
    InvalidInput
        It cannot be read, or others than its owner may read it.
    """
    check_private(path)
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path}: cannot be read ({error})") from None


def check_private(path: Path) -> None:
    """Refuse a file that others than its owner may read or write; InvalidInput says how to change that."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None
    if mode & 0o077:
        raise InvalidInput(f"{path}: has mode {mode:04o}, so that others may open it; make it 0600: chmod 600 {path}")


def write_private(path: Path, text: str) -> None:
    """Write a file of mode 0600, whole or not at all.

    Raises
    ------
    InvalidInput
        It cannot be written.
    """
    try:
        replace_file(path, text.encode(), durable=True, mode=PRIVATE)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be written ({error.strerror or error})") from None
