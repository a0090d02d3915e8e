"""What the numbers were measured on: nothing that names the machine or its owner."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("servotwin", "numpy", "scipy", "numba", "llvmlite", "heyoka")


def machine() -> dict[str, str | int]:
    """CPU, number of cores that may be used, operating system, versions of what computes."""
    versions = {name: _version(name) for name in PACKAGES}
    return {
        "cpu": _cpu(Path("/proc/cpuinfo")),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        **{name: found for name, found in versions.items() if found},
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
