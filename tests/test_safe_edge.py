"""Safe from the twin: no jump at a swap, and a loop that stays in its band whatever is sent."""

import copy
import math
import random
from dataclasses import replace

import numpy as np
import pytest

from servotwin.bench import hostile
from servotwin.bench.hostile import MARGIN
from servotwin.bench.hostiletwin import HONEST, HostileTwin, Kind
from servotwin.control.controller import Controller
from servotwin.cosim import Cosimulation, simulation_of
from servotwin.edge.parameters import gains_of
from servotwin.messages import Band, Cause, Gains, Reason
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import Simulation

BAND = Band(error=1.06e-4, error_rms=7.82e-5, effort=0.108, settling=hostile.SETTLING)
"""Measured: `hostile.certified(range(10_000, 10_300))`."""


def drawn(own: Controller, draw: random.Random) -> Controller:
    """Any controller in a wide box, with or without integral action."""
    return own.replace(
        Kp=own.Kp * math.exp(draw.uniform(-1.5, 1.5)),
        Ki=own.Ki * draw.choice([0.0, draw.uniform(0.0, 4.0)]),
        Kd=own.Kd * math.exp(draw.uniform(-1.5, 1.5)),
        Tf=own.Tf * math.exp(draw.uniform(-1.5, 1.5)),
        enter=0.5,
        leave=draw.uniform(0.5, 2.0),
        feedforward=draw.uniform(-0.25, 0.25),
    )


@pytest.mark.parametrize("rate", [None, 1000.0], ids=["continuous", "sampled"])
@pytest.mark.parametrize("seed", range(6))
def test_a_swap_does_not_move_the_voltage_on_identical_inputs(rate: float | None, seed: int) -> None:
    draw = random.Random(seed)
    servo = Servo.preset("paper").replace(sample_rate=rate)
    tolerances = draw.choice([0.0, 5e-5]), draw.choice([0.0, 1e-4])
    swapped = Simulation(
        servo, 3.0, reference=SquareWave(1e-3, 2.0), gap=math.radians(10), tolerance=tolerances[0], sample_rate=1000.0
    )
    at = draw.randrange(50, 2000)
    swapped.advance(at)
    kept = copy.deepcopy(swapped)
    swapped.set_controller(drawn(servo.controller, draw), tolerances[1])
    for simulation in (swapped, kept):
        simulation.advance(simulation.samples - 1)
    voltages = swapped.run().voltage[at], kept.run().voltage[at]
    assert abs(voltages[0] - voltages[1]) <= 0.01


def test_the_fallback_set_keeps_to_its_band() -> None:
    band = hostile.certified(range(500, 506))
    assert band.error < BAND.error
    assert band.error_rms < BAND.error_rms
    assert band.effort < BAND.effort


@pytest.mark.parametrize("kind", hostile.KINDS)
def test_the_loop_stays_in_its_band(kind: Kind) -> None:
    for outcome in hostile.endure(3, BAND, (kind,), first=20):
        assert outcome.worst < MARGIN
        assert outcome.outside == 0.0
        assert outcome.applied > 0 or Reason.OUT_OF_BOUNDS in outcome.refused


def test_silence_ends_in_the_fallback_set() -> None:
    (outcome,) = hostile.endure(1, BAND, (Kind.SILENT,), first=21)
    assert outcome.fallbacks == (Cause.SILENCE,)
    assert 1 <= outcome.applied <= HONEST


def test_old_updates_are_refused_however_they_are_numbered() -> None:
    (outcome,) = hostile.endure(1, BAND, (Kind.REPLAYS,), first=22)
    assert outcome.refused[Reason.OLD_DATA] > 0
    assert outcome.refused[Reason.OLD_VERSION] > 0


def test_what_leaves_the_band_is_brought_back() -> None:
    """Settings that nobody certified: some are unstable, and every loop recovers."""
    outcomes = hostile.endure(6, BAND, (Kind.WANTON,))
    assert all(outcome.recovered for outcome in outcomes)
    assert any(Cause.ERROR in outcome.fallbacks for outcome in outcomes)
    assert max(outcome.worst for outcome in outcomes) < 4.0


def test_equal_seeds_give_equal_bytes() -> None:
    digests = set()
    for _ in range(2):
        machine = hostile.case(3)
        scenario = hostile.scenario(machine, BAND, 3).replace(duration=30.0)
        own = gains_of(machine.servo.controller)
        twin = HostileTwin(scenario.name, Kind.WANTON, own, machine.servo.p, machine.gap, random.Random(3))
        plant = simulation_of(scenario)
        loop = Cosimulation(scenario, plant, twin=twin)
        while not loop.done:
            loop.advance()
        digests.add(loop.loop(plant.run()).digest())
    assert len(digests) == 1


def test_the_machine_runs_on_what_the_edge_put_in_force() -> None:
    machine = replace(hostile.case(3), input_bias=0.0, friction=0.0)
    scenario = hostile.scenario(machine, BAND, 3).replace(duration=12.0)
    own = gains_of(machine.servo.controller)
    twin = HostileTwin(scenario.name, Kind.LIES_LOW, own, machine.servo.p, 0.3, random.Random(3))
    plant = simulation_of(scenario)
    loop = Cosimulation(scenario, plant, twin=twin)
    while not loop.done:
        loop.advance()
    assert loop.agent.parameters.version > 0
    assert isinstance(loop.agent.parameters.gains, Gains)
    assert plant.controller == loop.agent.controller
    assert plant.controller.Kp == twin.said[loop.agent.parameters.version - 1].controller.Kp
    applied = next(receipt for receipt in loop.receipts if receipt.applied).sample
    tolerance = plant.run().tolerance
    assert np.all(tolerance[:applied] == 0.0)
    assert np.all(tolerance[applied : applied + 100] > 0.0)
