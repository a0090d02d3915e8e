"""Files that a configuration names, which have to be there before anything starts; some hold a secret.

The functions with `_table, _name` are for `config.keys.key(parse=...)`, which names file, key and value in an error.
"""

from __future__ import annotations

import math
import stat
from collections.abc import Mapping
from pathlib import Path

from servotwin.config.named_file import check_named
from servotwin.config.table import Table
from servotwin.errors import InvalidInput


def readable(_table: Table, _name: str, path: Path, _folder: Path) -> Path:
    """Return the path of a file that can be read."""
    _check_regular(path)
    return path


def secret_file(_table: Table, _name: str, path: Path, _folder: Path) -> str:
    """Return the secret in a file."""
    return read_secret(path)


def header_secret_file(_table: Table, _name: str, path: Path, _folder: Path) -> str:
    """Return the secret in a file that goes into a header of HTTP."""
    return read_secret(path, in_header=True)


def read_secret(path: Path, *, in_header: bool = False, longest: float = math.inf) -> str:
    """Read a private file with one line, without surrounding white space; no message shows it.

    Parameters
    ----------
    in_header : bool
        The secret goes into a header of HTTP: it has to be ASCII.
    longest : float
        Characters at most.

    Raises
    ------
    InvalidInput
        It cannot be read, others than its owner may read it, or it holds no such line, or a longer one.
    """
    check_private(path)
    try:
        return _line(path.read_text(encoding="utf-8"), str(path), in_header, longest)
    except UnicodeDecodeError as error:
        raise InvalidInput(f"{path}: is no text (byte {error.start} is not UTF-8)") from None


def secret_in(
    environment: Mapping[str, str], variable: str, *, in_header: bool = False, longest: float = math.inf
) -> str:
    """Read an environment variable as `read_secret` reads a file; raises InvalidInput."""
    return _line(environment.get(variable, ""), f"environment variable {variable}", in_header, longest)


def check_private(path: Path) -> None:
    """Refuse a file that cannot be read, or that others than its owner may read or write; raises InvalidInput."""
    mode = _check_regular(path)
    if mode & 0o077:
        raise InvalidInput(
            f"{path}: has mode {stat.S_IMODE(mode):04o}, so that others may open it; make it 0600: chmod 600 {path}"
        )


def _check_regular(path: Path) -> int:
    """Check that a path is that of a file that can be read, and return its mode."""
    check_named(path)
    try:
        path.open("rb").close()
        return path.stat().st_mode
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None


def _line(text: str, where: str, in_header: bool, longest: float) -> str:
    text, allowed = text.strip(), f"must hold one line of printable {'ASCII ' if in_header else ''}characters"
    if len(text) > longest:
        raise InvalidInput(f"{where}: has {len(text)} characters; at most {longest:g} are allowed")
    if not text:
        raise InvalidInput(f"{where}: is empty; it {allowed}")
    if not text.isprintable() or (in_header and not text.isascii()):
        raise InvalidInput(f"{where}: {allowed}")
    return text
