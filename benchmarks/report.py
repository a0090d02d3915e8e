"""JSON documents of the benchmarks: the output is checked before the measurement and written after it."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from servotwin.runtime import files

PACKAGES = ("servotwin", "numpy", "scipy", "numba", "llvmlite", "heyoka")


def check(output: Path | None) -> None:
    """Reject a file that cannot be written or is not .json, before the measurement; raises InvalidInput."""
    if output is not None:
        files.check_file(output, (".json",))


def text(schema: str, date: str, **parts: Any) -> str:
    """Encode a document: schema, date, machine and these parts; numbers that are not finite become null."""
    document = {"schema": schema, "date": date, "machine": dict(machine()), **parts}
    return msgspec.json.format(msgspec.json.encode(document, enc_hook=_plain), indent=1).decode() + "\n"


def write(output: Path | None, document: str, console: Console) -> None:
    """Write the document and print its path, if there is an output."""
    if output is not None:
        files.write_and_print(output, document, console.print)


def _plain(value: Any) -> Any:
    """Convert a NumPy number to Python's."""
    return value.item()


def machine() -> dict[str, str | int]:
    """CPU, number of usable cores, operating system and versions; nothing that names the machine or its owner."""
    versions = {name: _version(name) for name in PACKAGES}
    return {
        "cpu": _cpu(Path("/proc/cpuinfo")),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        **{name: host for name, host in versions.items() if host},
    }


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu(listing: Path) -> str:
    """The model's name, from Linux's listing or else from the interpreter."""
    try:
        lines = listing.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
