"""The edge's status as a small file, for people and for `servotwin up`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from servotwin.runtime.files import replace_file

SCHEMA = "servotwin-edge-status/1"


def write_status(path: Path, status: Mapping[str, Any]) -> None:
    """Replace the file as a whole; raises OSError. A status is old in a second: it is not flushed to the disk."""
    replace_file(path, msgspec.json.format(msgspec.json.encode({"schema": SCHEMA, **status})) + b"\n")


def read_status(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """The last status; None: there is none, or it is no status."""
    try:
        found = msgspec.json.decode(Path(path).read_bytes())
    except (OSError, msgspec.MsgspecError):
        return None
    return found if isinstance(found, dict) and found.get("schema") == SCHEMA else None
