"""The first call says that it compiles, to a person at a terminal and to nobody else."""

import io
import sys
from types import SimpleNamespace

from servotwin.hybrid.compile_progress import CompileProgress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def compilation(module="servotwin.hybrid.kernel"):
    return SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=module))})


def compile_two(module="servotwin.hybrid.kernel"):
    progress = CompileProgress()
    progress.on_start(compilation(module))
    progress.on_start(compilation("numba.cpython.builtins"))
    progress.on_end(compilation("numba.cpython.builtins"))
    progress.on_end(compilation(module))
    return progress


def terminal_of(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(sys, "__stderr__", stream)
    return stream


def test_a_terminal_sees_one_line_with_progress_that_vanishes(monkeypatch):
    terminal = terminal_of(monkeypatch)
    compile_two()
    lines = terminal.getvalue().split("\r")
    assert "compiling" in lines[1]
    assert ": 1, 0 s" in lines[1]
    assert ": 2, 0 s" in lines[2]
    assert lines[-1] == "\x1b[K"
    assert "\n" not in terminal.getvalue()
    assert max(map(len, lines)) <= 100


def test_a_terminal_with_a_progress_bar_sees_one_line(monkeypatch):
    terminal = terminal_of(monkeypatch)
    shared = Terminal()
    monkeypatch.setattr(sys, "stderr", shared)
    compile_two()
    assert shared.getvalue().count("compiling") == 1
    assert shared.getvalue().endswith("\n")
    assert terminal.getvalue() == ""


def test_a_pipe_sees_nothing(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(sys, "__stderr__", stream)
    compile_two()
    assert stream.getvalue() == ""


def test_compilations_of_other_packages_are_not_shown(monkeypatch):
    terminal = terminal_of(monkeypatch)
    compile_two("somebody.else")
    assert terminal.getvalue() == ""
