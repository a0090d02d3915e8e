"""Simulated machine of a scenario: its plant with its controller."""

from __future__ import annotations

from typing import Protocol

from servotwin.control.gains import with_gains
from servotwin.control.laws import AnyController
from servotwin.cosim.scenario import Scenario
from servotwin.edge.parameters import Parameters
from servotwin.edge.recorder import Floats
from servotwin.errors import InvalidInput
from servotwin.messages import Setting
from servotwin.plant.plants import Plant
from servotwin.plant.signals import PiecewiseCubic
from servotwin.simulation import Run, Simulation, simulate
from servotwin.simulation.endless import FOREVER, UnboundedSimulation, first_stretch


class Machine(Protocol):
    """Controlled machine with its controller: a `SimulatedMachine`, one behind a drive, or a stub in a test."""

    samples: int

    @property
    def index(self) -> int:
        """Number of the present sample."""

    def advance(self, index: int) -> None:
        """Advance to a sample."""

    def measured(self, name: str, first: int, last: int) -> Floats:
        """Return a channel at samples first .. last - 1, all before the present one."""

    def write(self, parameters: Parameters) -> None:
        """Put tolerance and gains in force from the present sample on; the voltage does not jump."""

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the present sample on, until the next call."""


class SimulatedMachine:
    """A simulation as a `Machine`.

    Parameters
    ----------
    scenario : Scenario
        Gives the limits of the controller, which no parameters change.
    simulation : Simulation, optional
        Of the scenario's own plant by default.
    """

    def __init__(self, scenario: Scenario, simulation: Simulation | None = None) -> None:
        self.simulation = simulation_of(scenario) if simulation is None else simulation
        self.samples, self._law = self.simulation.samples, scenario.law

    @property
    def index(self) -> int:
        """Number of the present sample."""
        return self.simulation.index

    def advance(self, index: int) -> None:
        """Advance to a sample."""
        self.simulation.advance(index)

    def measured(self, name: str, first: int, last: int) -> Floats:
        """Return a channel at samples first .. last - 1."""
        return self.simulation.measured(name, first, last)

    def write(self, parameters: Parameters) -> None:
        """Put tolerance and gains in force from the present sample on."""
        put_in_force(self.simulation, self._law, parameters.setting)

    def move(self, offset: float) -> None:
        """Add `offset` (m) to the reference from the present sample on."""
        self.simulation.move(offset)

    def run(self) -> Run:
        """Trajectory so far."""
        return self.simulation.run()


def put_in_force(simulation: Simulation | UnboundedSimulation, law: AnyController, setting: Setting) -> None:
    """Set the tolerance of a running simulation, and its gains where the setting has some; `law` has their limits."""
    if setting.gains is None:
        simulation.set_tolerance(setting.tolerance)
    else:
        simulation.set_controller(with_gains(law, setting.gains), setting.tolerance)


def simulation_of(scenario: Scenario, plant: Plant | None = None, delay: int = 0) -> Simulation:
    """Make the simulation of a scenario's plant and controller.

    `plant` replaces the scenario's servo where the machine differs from the model of twin and edge, and `delay` is in
    samples of its controller.
    """
    return _simulation(scenario, scenario.servo if plant is None else plant, delay=delay)


def endless(scenario: Scenario, keep: int, law: AnyController | None = None) -> UnboundedSimulation:
    """Make a simulation that runs on after the scenario's end and remembers `keep` samples; `law` replaces its own.

    Raises
    ------
    InvalidInput
        The controller is continuous.
    """
    if scenario.law.sample_rate is None:
        raise InvalidInput("controller sample_rate = None: must be a number in Hz for a machine that runs on")
    return UnboundedSimulation(_simulation(scenario, scenario.servo, keep, law=law), scenario.reference)


def compile_ahead(scenario: Scenario, law: AnyController | None = None) -> None:
    """Compile everything that a machine of this kind runs, so that no sample waits for a compilation."""
    law = scenario.law if law is None else law
    rate = law.sample_rate or scenario.recording.sample_rate
    gap = PiecewiseCubic.zero_order_hold([0.0, 1.5 / rate], [0.01, 0.02])
    simulate(scenario.servo, 4.0 / rate, controller=law, gap=gap, sample_rate=rate)


def _simulation(
    scenario: Scenario, plant: Plant, keep: int | None = None, delay: int = 0, law: AnyController | None = None
) -> Simulation:
    return Simulation(
        plant,
        scenario.duration if keep is None else FOREVER,
        controller=scenario.start_law if law is None else law,
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
