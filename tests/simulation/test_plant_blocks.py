"""Runs in noise with the plant in blocks of ticks: those of the ticks, their law's bits, their noise."""

from typing import Any

import numpy as np
import pytest
from exploration import extent
from random_sampled import DEGREE, SampledCase, largest_difference, random_case

from servotwin.control import law
from servotwin.hybrid.response import TICKS
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.simulation import Simulation, simulate
from servotwin.simulation.plant_block_engine import PlantBlockEngine, fits_plant_blocks, in_plant_blocks
from servotwin.simulation.sampled import SampledEngine

PAPER = Servo.preset("paper")


def noisy_case(seed: int) -> tuple[SampledCase, float]:
    """A random loop at a rate of 1 kHz or more, its sensor with or without counts, and its noise (m)."""
    rng = np.random.default_rng([31, seed])
    case = random_case(10_000 + seed)
    while case.controller.sample_rate < 999.0:
        case = random_case(int(rng.integers(1 << 30)))
    size = float(np.abs(case.inputs.reference.coeffs).max())
    if rng.random() < 0.5:
        case.servo = case.servo.replace(position_resolution=size * 10.0 ** rng.uniform(-4.0, -2.0))
    return case, size * 10.0 ** rng.uniform(-5.0, -1.5) if rng.random() < 0.85 else 0.0


def both(case: SampledCase, std: float, seed: int) -> tuple[SampledEngine, PlantBlockEngine]:
    """The run tick by tick, and with the plant in blocks."""
    ticked, blocks = case.noisy(std, seed), in_plant_blocks(case.noisy(std, seed))
    ticked.advance(ticked.samples - 1)
    blocks.advance(blocks.samples - 1)
    return ticked, blocks


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize("first", range(0, extent(50, 600), 50))
def test_random_loops_in_noise_are_those_of_the_ticks(first: int) -> None:
    """Same events, dead zone to the tick, states to 1e-8 of their range, measurements too."""
    for seed in range(first, first + 50):
        case, std = noisy_case(seed)
        ticked, blocks = both(case, std, seed)
        assert largest_difference(case, ticked, blocks) < 1e-8, seed
        measured = [engine.channel("measured_position", 0, case.samples) for engine in (ticked, blocks)]
        assert np.abs(measured[0] - measured[1]).max() <= 1e-8 * np.abs(measured[0]).max(), seed
        expected, found = ticked.events(), blocks.events()
        zones = [[event for event in events if event[1] in ("enter", "leave")] for events in (expected, found)]
        assert zones[0] == zones[1], seed
        # At a gap of zero, and where a gap jumps, rounding decides on pairs of events that move nothing.
        if np.all(case.inputs.gap.coeffs[:, 0] > 0.0) and case.inputs.gap.jumps.size == 0:
            assert [event[1:] for event in expected] == [event[1:] for event in found], seed
            times = np.array([[a[0], b[0]] for a, b in zip(expected, found, strict=True)]).reshape(-1, 2)
            assert np.all(np.abs(np.diff(times)) < 1e-6), seed


OPTIONS: dict[str, Any] = {"reference": SquareWave(1e-3, 2.0), "gap": 7.0 * DEGREE, "tolerance": 2e-5}


@pytest.mark.parametrize("resolution", [0.0, 1e-6])
def test_simulate_makes_long_runs_in_noise_in_blocks(resolution: float) -> None:
    """`simulate` and a `Simulation`, which is always tick by tick, take the same noise and agree."""
    servo = PAPER.replace(position_resolution=resolution)
    controller = servo.controller.replace(sample_rate=5e3, loop_filter_hz=50.0)
    options = OPTIONS | {"controller": controller, "sample_rate": 1e3, "noise": Noise(std=1e-5)}
    seeds = [np.random.default_rng(4), np.random.default_rng(4)]
    simulation = Simulation(servo, 8.0, seed=seeds[0], **options)
    simulation.advance(8000)
    ticked, run = simulation.run(), simulate(servo, 8.0, seed=seeds[1], **options)
    assert not np.array_equal(run.q, ticked.q)
    for name in ("q", "theta_m", "theta_d", "voltage", "measured_position"):
        expected, found = getattr(ticked, name), getattr(run, name)
        assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()
    assert run.events.kind.tolist() == ticked.events.kind.tolist()
    assert np.count_nonzero(run.events.kind == "contact") > 5


def test_the_law_in_blocks_gives_the_edge_s_bits() -> None:
    """Fed with what was measured, the interpreted law gives the same voltages: limits, noise, counts and dead zone."""
    servo = PAPER.replace(position_resolution=1e-6)
    controller = servo.controller.replace(
        sample_rate=5e3, voltage_limit=1.5, rate_limit=200.0, loop_filter_hz=40.0, enter=0.6, leave=1.4
    )
    run = simulate(servo, 6.0, controller=controller, sample_rate=5e3, noise=Noise(std=1e-5), **OPTIONS)
    parameters, state, voltages = controller.law(OPTIONS["tolerance"]), law.start(0.0), []
    for reference, measured in zip(run.reference.tolist(), run.measured_position.tolist(), strict=True):
        state = law.tick(parameters, state, reference, measured)
        voltages.append(state.voltage)
    assert np.array_equal(run.voltage, voltages)
    assert len(np.unique(run.voltage)) > 1000


@pytest.mark.parametrize("kind", ["white", "highpass"])
def test_the_noise_is_the_source_s(kind: Any) -> None:
    """What is measured less what is there are the very samples that the seed gives, with their spread."""
    controller, noise = PAPER.controller.replace(sample_rate=5e3), Noise(std=1e-5, kind=kind)
    run = simulate(PAPER, 20.0, controller=controller, sample_rate=5e3, noise=noise, seed=9, **OPTIONS)
    drawn = noise.source(5e3, np.random.default_rng(9)).block(run.samples)
    assert np.array_equal(run.measured_position, run.position + drawn)
    spread = float(np.std(run.measured_position - run.position))
    assert 0.97e-5 < spread < 1.03e-5


def test_contacts_inside_a_sample_are_located() -> None:
    """As in the ticks: between samples, where the screw meets the flank to rounding."""
    controller = PAPER.controller.replace(sample_rate=1e3)
    options = OPTIONS | {"controller": controller, "noise": Noise(std=2e-5), "sample_rate": 1e3, "seed": 2}
    run = simulate(PAPER, 21.0, **options)
    contacts = run.events.time[run.events.kind == "contact"]
    inside = contacts * 1e3 % 1.0
    assert contacts.size > 20
    assert np.count_nonzero((inside > 0.05) & (inside < 0.95)) > 0.7 * contacts.size
    beyond = np.abs(run.theta_m - run.theta_d) - 0.5 * run.gap
    assert beyond.max() < 1e-12 * np.abs(run.theta_m).max()


def test_most_ticks_are_in_whole_blocks() -> None:
    case = SampledCase(
        PAPER,
        PAPER.controller.replace(sample_rate=5e3),
        Simulation(PAPER, 8.0, **OPTIONS).inputs,
        0.0,
        40_001,
        0,
    )
    engine = case.noisy(1e-5, 0)
    assert fits_plant_blocks(engine)
    blocks = in_plant_blocks(engine)
    blocks.advance(40_000)
    starts = blocks.blocks.tick[: blocks.blocks.size[0]]
    assert np.mean(np.diff(starts) >= TICKS) > 0.5
    assert starts.size < 0.02 * 40_000


def test_short_runs_and_fast_samples_take_the_ticks() -> None:
    slow, fast = PAPER.controller.replace(sample_rate=1e3), PAPER.controller.replace(sample_rate=5e3)
    slowest = slow.replace(sample_rate=100.0)
    for controller, duration, rate in ((fast, 3.9, 5e3), (slow, 30.0, 5e3), (slowest, 300.0, 100.0)):
        noise = Noise(std=1e-6, kind="white")
        engine = Simulation(PAPER, duration, controller, sample_rate=rate, noise=noise).engine
        assert isinstance(engine, SampledEngine)
        assert not fits_plant_blocks(engine)


def test_a_gap_that_changes_inside_a_sample() -> None:
    gap = PiecewiseCubic.zero_order_hold([0.0, 1.50042, 3.3], np.array([3.0, 6.0, 0.5]) * DEGREE)
    controller = PAPER.controller.replace(sample_rate=5e3)
    options = OPTIONS | {"gap": gap, "controller": controller, "noise": Noise(std=1e-5), "sample_rate": 1e3}
    simulation = Simulation(PAPER, 5.0, **options)
    simulation.advance(5000)
    ticked, run = simulation.run(), simulate(PAPER, 5.0, **options)
    for name in ("q", "theta_m", "theta_d", "voltage"):
        assert np.abs(getattr(run, name) - getattr(ticked, name)).max() < 1e-8 * np.abs(getattr(ticked, name)).max()
    assert run.events.kind.tolist() == ticked.events.kind.tolist()
