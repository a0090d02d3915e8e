"""Files that a person names: a pipe or a terminal in a file's place would be waited for, perhaps for ever."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from servotwin.errors import InvalidInput


def check_named(path: str | os.PathLike[str], subject: str = "") -> None:
    """Refuse a path that is there and is no file, before it is opened; whoever opens it tells any other fault.

    Parameters
    ----------
    subject : str
        Begins the sentence, for example "log "; empty: the path does.

    Raises
    ------
    InvalidInput
        It is a folder, a pipe, a socket or a device.
    """
    try:
        mode = Path(path).stat().st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode):
        raise InvalidInput(f"{subject}{os.fspath(path)}: is {_kind(mode)}; give the name of a file")


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")
