"""Time of the edge's tick with the live view off, allowed, and watched, in turns within one run.

`python -m benchmarks.live_tick`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from statistics import median
from typing import Any

from rich.console import Console

RATE_HZ, SECONDS, ROUNDS = 5000.0, 4.0, 5
CASES = ("", "allowed", "watched")
_TIMES = {"answer": "sample to voltage", "whole": "whole tick"}


def live_ticks(rounds: int = ROUNDS, seconds: float = SECONDS, console: Console | None = None) -> dict[str, Any]:
    """Measure, show and return medians over rounds, µs: by case, time and share."""
    console = console or Console()
    runs: dict[str, list[dict[str, Any]]] = {case: [] for case in CASES}
    for _ in range(rounds):
        for case in CASES:
            runs[case].append(_run(case, seconds))
    result = {
        case or "off": {
            time: {share: median(run[time][share] for run in made) for share in ("median_us", "p99_us")}
            for time in _TIMES
        }
        for case, made in runs.items()
    }
    for time, name in _TIMES.items():
        figures = "; ".join(
            f"{case} {found[time]['median_us']:.1f} (p99 {found[time]['p99_us']:.1f})" for case, found in result.items()
        )
        console.print(f"{name}, µs, medians of {rounds} runs of {seconds:g} s at {RATE_HZ:g} Hz: {figures}")
    return result


def _run(case: str, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "benchmarks.tickloop", str(RATE_HZ), str(seconds), "1", "0", folder]
        done = subprocess.run([*command, case] if case else command, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


if __name__ == "__main__":
    live_ticks()
