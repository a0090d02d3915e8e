"""Twins as service processes of their own, for tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LISTENING = "servotwin twin: listening on "


@contextmanager
def service(path: Path) -> Iterator[str]:
    """A twin's service on any free port: its URL; it is asked to end, and must."""
    command = [sys.executable, "-m", "servotwin", "twin", "--config", str(path), "--port", "0"]
    log = (path.parent / "twin.log").open("ab")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True)
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith(LISTENING), (path.parent / "twin.log").read_text()
        yield line.removeprefix(LISTENING).strip()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0, (path.parent / "twin.log").read_text()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        log.close()
