"""What a bench that stands alone was asked to write down: checked before it begins, written when it is done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from benchmarks.machine import machine
from servotwin.runtime import files


def check(output: Path | None) -> None:
    """Refuse a file that cannot be written, or is not .json, before anything is measured; raises InvalidInput."""
    if output is not None:
        files.check_file(output, (".json",))


def text(schema: str, date: str, **parts: Any) -> str:
    """The document as JSON: schema, date, machine and these parts; what is not finite is null."""
    document = {"schema": schema, "date": date, "machine": dict(machine()), **parts}
    return msgspec.json.format(msgspec.json.encode(document, enc_hook=_plain), indent=1).decode() + "\n"


def write(output: Path | None, document: str, console: Console) -> None:
    """Write it, if it is wanted, and say so."""
    if output is not None:
        files.write_and_say(output, document, console.print)


def _plain(value: Any) -> Any:
    """A number of NumPy's as Python's."""
    return value.item()
