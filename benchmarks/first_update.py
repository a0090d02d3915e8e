"""Seconds from `servotwin up` in a new folder to its first applied update, and what they go by.

`python -m benchmarks.first_update [RUNS]`. Compiled code is at hand: a start before has left it in its cache.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

RUNS, LONGEST_S, POLL_S = 3, 120.0, 0.2
_LISTENING = "twin: listening on "
_SERVOS = "quick", "noisy", "remote"


def first_update() -> dict[str, float]:
    """Start, wait for the first applied update of any servo, end; return the times since the start, s."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "up"
        began, clock = time.monotonic(), time.time()
        command = [sys.executable, "-m", "servotwin", "up", "--folder", str(path)]
        running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert running.stdout is not None
        try:
            url = _address(running.stdout)
            times = {"address printed": time.monotonic() - began}
            token = (path / "operator.token").read_text().strip()
            times |= _applied(lambda part: _get(url + part, token), began, clock)
        finally:
            running.terminate()
            running.communicate()
    return times


def _address(lines: Any) -> str:
    for line in lines:
        if line.startswith(_LISTENING):
            return str(line.removeprefix(_LISTENING).strip())
    raise SystemExit("servotwin up ended before its twin listened")


def _applied(get: Callable[[str], Any], began: float, clock: float) -> dict[str, float]:
    """Times of the first window, estimate, update and applied update, by the twin's clock."""
    first: dict[str, float] = {}
    while "update applied" not in first:
        if time.monotonic() - began > LONGEST_S:
            raise SystemExit(f"no update was applied within {LONGEST_S:g} s; so far: {first}")
        for servo in _SERVOS:
            with suppress(OSError):
                _note(first, get(f"/v1/servos/{servo}/gaps"), clock)
        time.sleep(POLL_S)
    return first


def _note(first: dict[str, float], gaps: Any, clock: float) -> None:
    def earliest(name: str, times: list[float]) -> None:
        if times:
            first[name] = min(min(times) - clock, first.get(name, LONGEST_S))

    earliest("window stored", gaps["windows"]["received"])
    earliest("update sent", [each["sent"] for each in gaps["versions"]])
    earliest("update applied", [each["answered"] for each in gaps["versions"] if each["applied"]])


def _get(url: str, token: str) -> Any:
    with urlopen(Request(url, headers={"authorization": f"Bearer {token}"}), timeout=5.0) as answer:
        return json.load(answer)


if __name__ == "__main__":
    for _ in range(int(sys.argv[1]) if len(sys.argv) > 1 else RUNS):
        print("; ".join(f"{name} {seconds:.1f} s" for name, seconds in first_update().items()))
