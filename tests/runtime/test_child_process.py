"""Child processes: they end when they are asked to, when they are killed, and when their parent is gone."""

import signal
import subprocess
import sys
from pathlib import Path

from servotwin.runtime.child_process import ChildProcess, last_line

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); input()"


def test_a_child_that_does_not_end_in_time_is_killed() -> None:
    child = ChildProcess([sys.executable, "-c", STUBBORN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, group=True)
    assert child.stdout is not None
    assert child.stdout.readline() == b"1\n"
    child.terminate()
    assert child.code is None
    assert child.wait(0.05) == child.code == -signal.SIGKILL
    child.kill()  # once more, which does nothing
    child.close()


def test_a_module_ends_when_its_standard_input_does() -> None:
    command = [sys.executable, "-m", "servotwin.runtime.child_process", "http.server", "--bind", "127.0.0.1", "0"]
    child = ChildProcess(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, group=True)
    child.close()
    assert child.wait(10.0) in (-signal.SIGTERM, 0)


def test_the_last_line_of_a_log_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert last_line(tmp_path / "missing.log") == ""
    (tmp_path / "a.log").write_text("first\nlast words\n\n")
    assert last_line(tmp_path / "a.log") == "last words"
