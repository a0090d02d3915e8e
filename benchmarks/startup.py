"""Time of a fresh process to its first result: interpreter, imports, tables and compiled code."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks import hold, taylor
from benchmarks.contest import Contestant, Job
from servotwin.hybrid.automaton import Array

_FIRST_RUN = "from benchmarks.workloads import WearWorkload; from benchmarks import {module} as contestant; " + (
    "contestant.wearing(WearWorkload(duration=1.0, period=1.0){rate}).prepare()()"
)


def starting(module: str, name: str, rate: str = "", cached: bool = True, missing: str = "") -> Contestant:
    """A run of 1 s in a process of its own, with compiled code from the disk or compiled anew."""
    program = _FIRST_RUN.format(module=module, rate=rate)

    def start(environment: dict[str, str]) -> Array:
        subprocess.run([sys.executable, "-c", program], check=True, env=environment)
        return np.empty(0)

    def prepare() -> Job:
        if cached:
            start(dict(os.environ))
            return lambda: start(dict(os.environ))
        return from_nothing

    def from_nothing() -> Array:
        with tempfile.TemporaryDirectory() as directory:
            return start({**os.environ, "NUMBA_CACHE_DIR": directory})

    return Contestant(name, prepare, missing)


def starters(slow: bool) -> tuple[Contestant, ...]:
    """Contestants; a full compilation takes half a minute and needs --slow."""
    anew = (starting("ours", "servotwin, compiled anew", cached=False),) if slow else ()
    return (
        starting("ours", "servotwin, cached"),
        *anew,
        starting("hold", f"{hold.NAME}, cached", rate=", 5000.0"),
        starting("taylor", taylor.NAME, missing=taylor.MISSING),
    )
