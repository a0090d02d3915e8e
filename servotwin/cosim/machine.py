"""Simulated machine of a scenario: its plant with its controller."""

from __future__ import annotations

from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic
from servotwin.simulation import Simulation, simulate
from servotwin.simulation.endless import FOREVER, UnboundedSimulation, first_stretch


def simulation_of(scenario: Scenario, plant: Servo | None = None, delay: int = 0) -> Simulation:
    """Make the simulation of a scenario's plant and controller.

    `plant` replaces the scenario's servo where the machine differs from the model of twin and edge, and `delay` is in
    samples of its controller.
    """
    return _simulation(scenario, scenario.servo if plant is None else plant, delay=delay)


def endless(scenario: Scenario, keep: int) -> UnboundedSimulation:
    """Make a simulation that runs on after the scenario's end and remembers `keep` samples.

    Raises
    ------
    InvalidInput
        The controller is continuous.
    """
    if scenario.law.sample_rate is None:
        raise InvalidInput("controller sample_rate = None: must be a number in Hz for a machine that runs on")
    return UnboundedSimulation(_simulation(scenario, scenario.servo, keep), scenario.reference)


def compile_ahead(scenario: Scenario) -> None:
    """Compile everything that a machine of this kind runs, so that no sample waits for a compilation."""
    rate = scenario.law.sample_rate or scenario.recording.sample_rate
    gap = PiecewiseCubic.held([0.0, 1.5 / rate], [0.01, 0.02])
    simulate(scenario.servo, 4.0 / rate, controller=scenario.law, gap=gap, sample_rate=rate)


def _simulation(scenario: Scenario, plant: Servo, keep: int | None = None, delay: int = 0) -> Simulation:
    return Simulation(
        plant,
        scenario.duration if keep is None else FOREVER,
        controller=scenario.start_law,
        reference=scenario.reference if keep is None else first_stretch(scenario.reference),
        gap=scenario.gap,
        tolerance=scenario.start_tolerance,
        theta_d0=scenario.theta_d0,
        sample_rate=scenario.recording.sample_rate,
        noise=scenario.noise,
        seed=scenario.seed_of("noise"),
        input_bias=scenario.input_bias,
        friction=scenario.friction,
        keep=keep,
        delay=delay,
    )
