"""Automata of many servos at once, against those of each."""

import itertools
import math

import numpy as np
import pytest

from benchmarks.workloads import knocking_drive
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import AutomatonStack
from servotwin.plant.automaton import ServoAutomaton, Shape, continuous_loop, sampled_plant
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.stack import LoopStack, continuous_loops, sampled_plants

PAPER = Servo.preset("paper")
PLANTS = [
    {"k": 9e3, "m": 4.0, "k_T": 0.9 * PAPER.k_T},
    {"c": (10.0, 12.0, 14.0), "p": 1.1 * PAPER.p, "R": 1.2 * PAPER.R},
    {"J": 2.0 * PAPER.J, "L": 0.5 * PAPER.L, "k_B": 1.1 * PAPER.k_B},
]


def assert_equal(stack: LoopStack, place: int, one: ServoAutomaton) -> None:
    """Bit for bit, so that it does not matter which of the two ways an automaton was made."""
    first = stack.first.automaton
    assert (one.automaton.names, one.zones) == (first.names, stack.first.zones)
    assert np.array_equal(one.automaton.flows, stack.automata.flows[place])
    for m, mode in enumerate(one.automaton.modes):
        assert mode.name == first.modes[m].name
        for g, guard in enumerate(mode.guards):
            twin = first.modes[m].guards[g]
            assert (guard.target, guard.label, guard.side) == (twin.target, twin.label, twin.side)
            assert np.array_equal(guard.row, stack.automata.rows[place, m, g])
            assert (guard.reset is None) == (twin.reset is None)
            if guard.reset is not None:
                assert np.array_equal(guard.reset, stack.automata.resets[place, m, g])
    assert one.rows.keys() == stack.rows.keys()
    assert all(np.array_equal(row, stack.rows[name][place]) for name, row in one.rows.items())


@pytest.mark.parametrize(
    ("k_d", "friction", "dead_zone", "limit", "filtered"),
    list(itertools.product((math.inf, 1e6), (False, True), (False, True), (None, 12.0), (None, 20.0))),
)
def test_a_stack_is_its_automata(k_d, friction, dead_zone, limit, filtered) -> None:
    servos = [PAPER.replace(k_d=k_d, **changes) for changes in PLANTS]
    laws = [
        PAPER.controller.replace(Kp=500.0 + i, Ki=3.0 * i, voltage_limit=limit, loop_filter_hz=filtered)
        for i in range(len(servos))
    ]
    shape = Shape(dead_zone=dead_zone, bias=friction, friction=friction, gap=2)
    loops, plants = continuous_loops(servos, laws, shape), sampled_plants(servos, 1, True, friction)
    for place, (servo, law) in enumerate(zip(servos, laws, strict=True)):
        assert_equal(loops, place, continuous_loop(servo, law, shape))
        assert_equal(plants, place, sampled_plant(servo, 1, True, friction))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "friction"), [("two-mass-drive", False), ("robot-joint", True), ("ball-screw", True)])
def test_a_stack_of_axes_is_their_automata(name: str, friction: bool) -> None:
    """Shafts that are free in the gap, with friction of motor and load; to rounding, as sums are taken otherwise."""
    preset = knocking_drive() if name == "two-mass-drive" else Axis.preset(name)
    axis = preset.replace(sample_rate=None)
    axes = [axis.scaled(factors) for factors in ({"k": 1.1}, {"c": 0.5, "p": 1.02}, {"m": 1.2, "k_T": 0.9, "k_B": 1.3})]
    laws = [axis.pidf.replace(Kp=axis.pidf.Kp * (1.0 + 0.1 * i)) for i in range(len(axes))]
    shape = Shape(friction=friction, gap=2)
    loops, plants = continuous_loops(axes, laws, shape), sampled_plants(axes, 1, True, friction)
    for place, (one, law) in enumerate(zip(axes, laws, strict=True)):
        for stack, single in (
            (loops, continuous_loop(one, law, shape)),
            (plants, sampled_plant(one, 1, True, friction)),
        ):
            flows = single.automaton.flows
            assert np.abs(stack.automata.flows[place] - flows).max() <= 1e-14 * np.abs(flows).max()
            for m, mode in enumerate(single.automaton.modes):
                for g, guard in enumerate(mode.guards):
                    row = np.asarray(guard.row)
                    assert stack.automata.rows[place, m, g] == pytest.approx(
                        row, rel=1e-13, abs=1e-13 * np.abs(row).max()
                    )


def test_numbers_of_automata_that_were_made_one_by_one() -> None:
    servos = [PAPER.replace(**changes) for changes in PLANTS]
    stack = sampled_plants(servos, 0, False, False).automata
    again = AutomatonStack.of([sampled_plant(servo, 0).automaton for servo in servos])
    assert all(np.array_equal(getattr(stack, name), getattr(again, name)) for name in ("flows", "rows", "resets"))
    flows = stack.flows.copy()
    flows[1, 0, 0, 0] = np.inf
    with pytest.raises(InvalidInput, match="a flow of a stack of automata holds a number that is not finite"):
        AutomatonStack(stack.first, flows, stack.rows, stack.resets)
