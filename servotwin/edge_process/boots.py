"""Names of boots: unique for ever, so that no window of one is taken for a window of another."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from servotwin.runtime.files import replace_file


def next_boot(path: Path, random: bytes) -> str:
    """A name for this start: how many there were, and something random where the count is lost.

    Parameters
    ----------
    path : path
        Holds the number of starts; where it cannot be read or written the name is unique all the same.
    random : bytes
        8 bytes.
    """
    count = _count(path) + 1
    with suppress(OSError):
        replace_file(path, f"{count}\n".encode("ascii"), durable=True)
    return f"b{count}-{random.hex()}"


def _count(path: Path) -> int:
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return 0
    return int(text) if text.isdigit() and len(text) < 16 else 0
