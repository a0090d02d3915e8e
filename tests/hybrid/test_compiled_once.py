"""What a kernel is given has the same types for every order and access of a caller's arrays: others compile it anew."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import typeof

import servotwin as st
from servotwin.estimation.core import family, reduced
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.family import structure_family
from servotwin.estimation.core.reduced import reduced_response
from servotwin.estimation.core.response import response
from servotwin.estimation.paper import observer
from servotwin.estimation.paper.observer import LagFilter
from servotwin.hybrid import ensemble
from servotwin.hybrid.automaton import Automaton, AutomatonStack, Mode
from servotwin.simulation import lifted_engine

PAPER = st.Servo.preset("paper")


def given(monkeypatch: pytest.MonkeyPatch, module: Any, kernel: str) -> list[tuple[Any, ...]]:
    """Types of the arguments of every call of a kernel from now on."""
    types, call = [], getattr(module, kernel)

    def noted(*arguments: Any) -> Any:
        types.append(tuple(map(typeof, arguments)))
        return call(*arguments)

    monkeypatch.setattr(module, kernel, noted)
    return types


def read_only(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values.flags.writeable = False
    return values


LINE = np.linspace(0.0, 1.0, 60)


@pytest.mark.parametrize("other", [read_only, lambda line: np.repeat(line, 2)[::2]], ids=["read-only", "strided"])
@pytest.mark.parametrize(
    ("module", "kernel", "respond"),
    [
        (family, "_respond", lambda line: structure_family(PAPER).sampled(1000.0).respond(line)),
        (observer, "subtract_section", lambda line: LagFilter.sampled(np.ones(1), 2, 40.0, 1e-3).respond(line)),
    ],
    ids=["family", "observer"],
)
def test_responses(
    monkeypatch: pytest.MonkeyPatch,
    module: Any,
    kernel: str,
    respond: Callable[[np.ndarray], np.ndarray],
    other: Callable[[np.ndarray], np.ndarray],
) -> None:
    types = given(monkeypatch, module, kernel)
    assert np.array_equal(respond(LINE), respond(other(LINE)))
    assert len(set(types)) == 1


def test_responses_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    model, types = reduced_response(response(PAPER, 5000.0), decimation(9)), given(monkeypatch, reduced, "run_blocks")
    angles = np.outer([1.0, 2.0], np.sin(np.arange(900) / 50.0))
    assert np.array_equal(model.respond(angles), model.respond(np.asfortranarray(angles)))
    assert len(set(types)) == 1


def test_outputs_of_an_ensemble() -> None:
    stack = AutomatonStack.of([Automaton((Mode(-np.eye(2)),), ("x", "y"))] * 3)
    rows = np.arange(18.0).reshape(3, 3, 1, 2)
    one, other = (ensemble._family(stack, each, 0.1) for each in (rows, np.asfortranarray(rows)))
    assert np.array_equal(one.outputs, other.outputs)
    assert typeof(one) == typeof(other)


def test_references_of_a_sampled_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiled ensemble calls the same kernel with an array of its own."""
    types = given(monkeypatch, lifted_engine, "run_lifted")
    law = PAPER.controller.replace(sample_rate=5e3, loop_filter_hz=50.0)
    options = {"reference": st.SquareWave(1e-3, 2.0), "gap": 0.1, "tolerance": 2e-5, "sample_rate": 1e3}
    st.simulate(PAPER, 8.0, controller=law, **options)
    assert types
    assert all(each[3].mutable for each in types)
