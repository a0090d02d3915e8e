"""Compilation cached on disk: the key is the same in every process, and follows what a function uses."""

import importlib
import os
import pkgutil
import subprocess
import sys
from typing import Any

import pytest
from numba import float64

import servotwin
from servotwin.errors import InvalidInput
from servotwin.hybrid.compiled import bare, compiled, stamp, subroutine

LIST_STAMPS = """
import importlib, pkgutil, servotwin.hybrid, servotwin.simulation
for package in (servotwin.hybrid, servotwin.simulation):
    for found in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
        module = importlib.import_module(found.name)
        for name, value in sorted(vars(module).items()):
            if hasattr(value, "stamp"):
                print(module.__name__, name, value.stamp)
"""


def stamps(seed: int) -> str:
    env = os.environ | {"PYTHONHASHSEED": str(seed), "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run([sys.executable, "-c", LIST_STAMPS], env=env, capture_output=True, text=True, check=True)
    return done.stdout


@pytest.mark.slow
def test_stamps_do_not_depend_on_the_process() -> None:
    """Otherwise every other run would compile again."""
    first = stamps(0)  # seeds 0 and 4 order a set of two words differently
    assert first.count("\n") > 20
    assert stamps(4) == first


def test_every_helper_stands_above_its_callers() -> None:
    """Only then does a caller's stamp follow it: the stamp made again, now that all is defined, is the same."""
    for found in pkgutil.walk_packages(servotwin.__path__, "servotwin."):
        if not found.name.endswith(("__main__", "migrations.env")):  # both run when imported
            for value in vars(importlib.import_module(found.name)).values():
                if hasattr(value, "stamp") and hasattr(value, "py_func"):
                    assert stamp(value.py_func, value.options_key) == value.stamp, value


def helper_plus_one(x: float) -> float:
    return x + 1.0


def helper_plus_two(x: float) -> float:
    return x + 2.0


helper, FACTOR = helper_plus_one, 1.0


def caller(x: float) -> float:
    return helper(x) * FACTOR


@pytest.fixture
def stamp_of(monkeypatch: pytest.MonkeyPatch):
    def stamp(helper: object, factor: float) -> str:
        monkeypatch.setitem(globals(), "helper", helper)
        monkeypatch.setitem(globals(), "FACTOR", factor)
        return compiled(caller).stamp

    return stamp


def test_stamps_follow_helpers_and_constants(stamp_of) -> None:
    plus_one, plus_two = compiled(helper_plus_one), compiled(helper_plus_two)
    base = stamp_of(plus_one, 2.0)
    assert stamp_of(plus_one, 2.0) == base
    assert stamp_of(plus_two, 2.0) != base
    assert stamp_of(plus_one, 3.0) != base
    assert compiled(caller).py_func(1.0) == 6.0


def test_a_cache_that_has_no_place_is_a_sentence(monkeypatch):
    """As under a service manager: servotwin's folder is read-only and its user has no home."""

    def refused(_self, py_func):
        raise RuntimeError(f"cannot cache function {py_func.__name__!r}: no locator available for file 'x.py'")

    monkeypatch.setattr("numba.core.caching.FunctionCache.__init__", refused)
    with pytest.raises(InvalidInput, match="set the environment variable NUMBA_CACHE_DIR to a folder that is"):
        compiled(lambda x: x)


RENAMED = """
from typing import NamedTuple

import numpy as np

from servotwin.hybrid.compiled import compiled


class {name}(NamedTuple):
    values: np.ndarray


@compiled
def first(pair):
    return pair.values[0]


print(first({name}(np.array([2.5]))))
"""


@pytest.mark.slow
def test_a_cache_that_names_a_renamed_type_is_compiled_anew(tmp_path):
    """As after an update of servotwin: the old cache lies beside the new code."""
    outputs = []
    for name in ("Before", "After", "After"):
        (tmp_path / "renamed.py").write_text(RENAMED.format(name=name))
        run = [sys.executable, "-c", "import renamed"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
        outputs.append(subprocess.run(run, env=environment, check=True, capture_output=True, text=True).stdout)
    assert outputs == ["2.5\n"] * 3
    assert list((tmp_path / "__pycache__").glob("renamed.first-*.nbi"))


@subroutine
def fma_by_hand(a: float, b: float, c: float) -> float:
    return a * b + c


@bare
def with_subroutine(a: float, b: float, c: float) -> float:
    return fma_by_hand(a, b, c)


@pytest.mark.slow
def test_a_subroutine_is_a_part_of_its_callers_and_python_can_call_it() -> None:
    """Its library holds no function that is executable; what Python calls is compiled for that, and gives the same."""
    values = 0.1, 0.2, 0.3
    assert with_subroutine(*values) == fma_by_hand(*values)
    part: Any = fma_by_hand
    part.compile((float64,) * 3)
    (version,) = part.overloads.values()
    assert not version.library.codegen._engine._ee.get_function_address(version.fndesc.llvm_func_name)
    assert fma_by_hand(2.0, 3.0, 4.0) == 10.0


def test_with_another_version_of_numba_a_subroutine_is_compiled_as_any_function(monkeypatch) -> None:
    monkeypatch.setattr("servotwin.hybrid.compiled.TRIED", False)
    part: Any = subroutine(fma_by_hand.py_func)
    assert part(2.0, 3.0, 4.0) == 10.0
    (version,) = part.overloads.values()
    assert version.library.codegen._engine._ee.get_function_address(version.fndesc.llvm_func_name)


SUBROUTINE = """
import sys

import numpy as np
from numba.core.event import install_recorder

from servotwin.hybrid.compiled import bare, compiled, subroutine


@subroutine
def at(values, k):
    if k >= len(values):
        raise IndexError
    return values[k]


@bare
def first(values):
    return at(values, 0) * 2.0


@compiled
def both(values):
    return first(values) + at(values, 0) * np.ones(2)


with install_recorder("numba:compile") as recorder:
    result = (first if sys.argv[1] == "first" else both)(np.array([2.5]))
names = {event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer}
print(float(np.sum(result)), *sorted(names & {"at", "first", "both"}), "numba.np.linalg" in sys.modules)
"""


@pytest.mark.slow
def test_other_processes_load_what_is_cached_and_register_nothing_to_compile(tmp_path):
    """A cached function is linked into a caller that is compiled later; one that is only called brings no compiler."""
    (tmp_path / "parts.py").write_text(SUBROUTINE)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    outputs = []
    for name in ("first", "both", "both"):
        run = [sys.executable, str(tmp_path / "parts.py"), name]
        outputs.append(subprocess.run(run, env=environment, check=True, capture_output=True, text=True).stdout.split())
    assert outputs == [["5.0", "at", "first", "True"], ["15.0", "both", "True"], ["15.0", "False"]]
