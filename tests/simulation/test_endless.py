"""A simulation without an end, and one whose voltage comes from outside: the same bits, in bounded memory."""

from dataclasses import replace

import numpy as np
import pytest

from servotwin.control import law
from servotwin.cosim.machine import endless, simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.cosim.scenario_file import Recording
from servotwin.drives.simulated.pace import Pace
from servotwin.errors import InvalidInput
from servotwin.plant.noise import Noise
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Simulation
from servotwin.simulation.endless import OpenLoopPlant

CHANNELS = ("reference", "theta_m", "position", "voltage")
DEGREE = np.pi / 180.0


def worn(duration: float, rate: float = 1000.0, ticks: float = 1000.0) -> Scenario:
    """Noise, a bias, a dead zone, and a gap that wears all the time."""
    base = Scenario.preset("fig15-sampled")
    return base.replace(
        duration=duration,
        recording=Recording(sample_rate=rate),
        controller=base.law.replace(sample_rate=ticks),
        reference=SquareWave(1e-3, 7.0),
        gap=SCurve(0.0, 12.0 * DEGREE, 0.8 * duration, 0.0123),
        noise=Noise(0.02e-3),
        input_bias=0.05,
        twin=replace(base.twin, initial_gap=2.0 * DEGREE),
    )


def measured(simulation: Simulation, first: int, last: int) -> np.ndarray:
    return np.array([simulation.measured(name, first, last) for name in CHANNELS])


@pytest.mark.parametrize(("rate", "ticks"), [(1000.0, 1000.0), (500.0, 1000.0), (1000.0, 250.0)])
def test_blocks_of_any_length_are_the_simulation_with_an_end(rate: float, ticks: float) -> None:
    scenario, random = worn(40.0, rate, ticks), np.random.default_rng(1)
    whole, machine = simulation_of(scenario), endless(scenario, keep=700)
    laws = [scenario.start_law, scenario.start_law.replace(Kp=1000.0, leave=1.5)]
    while (first := machine.index) < whole.samples - 1000:
        last = first + int(random.integers(1, 700))
        for each in (whole, machine):
            each.advance(last)
            each.set_controller(laws[0], float(last % 5) * 1e-5)
        laws.reverse()
        assert np.array_equal(measured(machine.simulation, first, last), measured(whole, first, last))
    assert machine.simulation.inputs.tolerance.times.size < 50 < whole.inputs.tolerance.times.size


def test_over_stretches_nothing_grows_and_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servotwin.simulation.endless.STRETCH", 50.0)
    scenario = worn(420.0, 500.0, 500.0)
    whole, machine = simulation_of(scenario), endless(scenario, keep=2000)
    whole.advance(whole.samples - 1)
    sizes = set()
    while machine.index < whole.samples - 1:
        machine.advance(min(machine.index + 4321, whole.samples - 1))
        engine, inputs = machine.engine, machine.simulation.inputs
        sizes.add(engine.output.states.shape + engine.output.measured.shape)
        assert inputs.reference.times.size <= 2 * 51 / 3.5 + 4
        assert len(engine.record.event_step) < 100_000
        assert engine.draws.drawn.size <= 1 << 16
        first = machine.index - 2000
        assert np.array_equal(measured(machine.simulation, first, machine.index), measured(whole, first, machine.index))
    assert len(sizes) == 1


def test_a_move_goes_on_over_a_stretch_and_ends() -> None:
    scenario = worn(20.0).replace(reference=1e-3)
    machine, plain = endless(scenario, keep=1000), simulation_of(scenario)
    machine.advance(1000)
    machine.move(2e-4)
    machine.lay_out()
    machine.advance(2000)
    assert set(machine.measured("reference", 1000, 2000)) == {1e-3 + 2e-4}
    machine.move(0.0)
    machine.advance(3000)
    assert set(machine.measured("reference", 2000, 3000)) == {1e-3}
    plain.advance(3000)
    assert plain.measured("position", 2999, 3000) != machine.measured("position", 2999, 3000)


def test_what_is_forgotten_is_not_given() -> None:
    machine = endless(worn(20.0), keep=100)
    machine.advance(5000)
    with pytest.raises(InvalidInput, match=r"samples 4800 \.\. 4810 are outside 4900 \.\. 5001"):
        machine.measured("position", 4800, 4810)
    with pytest.raises(InvalidInput, match="a simulation that stores only its last samples has no run"):
        machine.simulation.run()
    with pytest.raises(InvalidInput, match=r"keep = 0 samples"):
        endless(worn(20.0), keep=0)
    with pytest.raises(InvalidInput, match="must be a number in Hz"):
        endless(Scenario.preset("fig15"), keep=100)


@pytest.mark.slow
def test_a_held_voltage_is_the_law_s_own_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Across stretches of the reference, the gap's knots and chunks of the inputs."""
    monkeypatch.setattr("servotwin.simulation.endless.STRETCH", 11.0)
    scenario = worn(30.0)
    whole, held = simulation_of(scenario), OpenLoopPlant(endless(scenario, keep=64))
    whole.advance(whole.samples - 1)
    run, state = whole.run(), law.start(0.0)
    parameters = scenario.start_law.law(scenario.start_tolerance)
    seen = []
    while held.index < run.samples - 1:
        reference, theta_m, position = held.sample()
        assert held.sample() == (reference, theta_m, position)
        state = law.tick(parameters, state, reference, position)
        seen.append((reference, theta_m, position, state.voltage))
        held.hold(state.voltage)
    for values, name in zip(np.array(seen).T, CHANNELS, strict=True):
        assert np.array_equal(values, run.measured(name)[:-1]), name


def test_samples_must_be_ticks_where_the_voltage_comes_from_outside() -> None:
    with pytest.raises(InvalidInput, match=r"controller sample_rate = 500\.0 Hz: must be the recording's, 1000\.0 Hz"):
        OpenLoopPlant(endless(worn(20.0, 1000.0, 500.0), keep=64))


def test_a_pace_catches_up_and_gives_up_what_is_beyond_its_slack() -> None:
    pace = Pace(rate=1000.0, speed=4.0, slack=0.5, now=10.0)
    assert pace.due(4000) == pytest.approx(11.0)
    assert pace.reached(10.99999) == 3999
    assert pace.catch_up(4000, 10.9) == 0.0
    assert pace.catch_up(4000, 11.25) == pytest.approx(1.0)
    assert pace.due(4400) == pytest.approx(11.1)
    assert pace.catch_up(4000, 14.0) == pytest.approx(2.0)
    assert pace.due(4000) == pytest.approx(13.5)
