"""Processes that start together compile once; one that dies or hangs meanwhile does not stop the others."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from servotwin.hybrid.compile_lock import waited_for
from servotwin.runtime.locks import locked

MODULE = """
import os
import time
from pathlib import Path

from numba.core.event import install_recorder

from servotwin.hybrid.compiled import compiled


@compiled
def part(x):
    return x + 1.0


@compiled
def whole(x):
    return 2.0 * part(x)


@compiled
def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)


def wait_for(name):
    while not Path(name).exists():
        time.sleep(0.001)


if "HANG" in os.environ:
    from numba.core import compiler

    compile_it = compiler.compile_extra

    def compile_later(*given, **more):
        Path("hangs").touch()
        wait_for("never")

    compiler.compile_extra = compile_later
else:
    wait_for("go")
with install_recorder("numba:compile") as recorder:
    results = whole(3.0), factorial(5)
names = [event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer if event.is_start]
print(*results, *sorted(set(names) & {"part", "whole", "factorial"}))
"""


@pytest.fixture
def start(tmp_path: Path):
    """Start a process that imports the module, all with the same empty cache."""
    (tmp_path / "shared.py").write_text(MODULE)
    processes: list[subprocess.Popen[str]] = []

    def started(**more: str) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]), **more}
        run = [sys.executable, "-c", "import shared"]
        processes.append(subprocess.Popen(run, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True))
        return processes[-1]

    yield started
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_processes_at_once_compile_everything_once(start, tmp_path: Path) -> None:
    """A function that calls itself does not wait for itself."""
    processes = [start() for _ in range(2)]
    (tmp_path / "go").touch()
    outputs = [process.communicate(timeout=100)[0].split() for process in processes]
    assert [output[:2] for output in outputs] == [["8.0", "120"]] * 2
    assert sorted(name for output in outputs for name in output[2:]) == ["factorial", "part", "whole"]


@pytest.mark.slow
def test_a_process_that_is_killed_while_it_compiles_leaves_the_work_to_the_next(start, tmp_path: Path) -> None:
    hanging = start(HANG="yes")
    while not (tmp_path / "hangs").exists():
        assert hanging.poll() is None
        time.sleep(0.01)
    waiting = start()
    (tmp_path / "go").touch()
    with pytest.raises(subprocess.TimeoutExpired):
        waiting.communicate(timeout=3.0)
    hanging.send_signal(signal.SIGKILL)
    assert waiting.communicate(timeout=100)[0].split() == ["8.0", "120", "factorial", "part", "whole"]


def test_nobody_waits_longer_than_allowed(tmp_path: Path) -> None:
    path = tmp_path / "new" / "lock"
    with waited_for(path, 0.0) as first:
        assert first
        begin = time.monotonic()
        with waited_for(path, 0.2) as second:
            assert not second
        assert time.monotonic() - begin >= 0.2
    with waited_for(path, 0.0) as again:
        assert again


def test_without_a_place_for_locks_nothing_is_waited_for(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with waited_for(tmp_path / "file" / "lock") as has:
        assert not has


def test_an_exception_releases_the_lock(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), waited_for(tmp_path / "lock"):
        raise ZeroDivisionError
    with locked(tmp_path / "lock"):
        pass
