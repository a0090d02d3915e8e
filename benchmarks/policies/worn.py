"""Machines that differ from their model, wear, and step back and forth: seven blocks, each with its disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.commissioning.edge_settings import Recording
from servotwin.control.controller import Controller
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Run, Simulation
from servotwin.twin.settings import TwinSettings

BLOCKS = ("model error", "bias", "friction", "saturation", "delay", "quantisation", "all")
RATE = 1000.0
HALF_PERIOD, STEPS = 15.0, 12
DURATION = HALF_PERIOD * STEPS
# Widths of the model's error, relative.
_ERRORS = {"k": 0.05, "c": 0.3, "k_T": 0.1, "k_B": 0.1}
BIAS = 0.1
"""V, largest, either sign; the largest friction is the torque that this voltage stalls."""
_VOLTAGE_LIMIT, _DELAY, RESOLUTION = 1.0, 3, 1e-6
_GAPS, _WEAR = math.radians(30.0), math.radians(5.0)
_AMPLITUDES = (1.5e-4, 1.25e-3)


@dataclass(frozen=True)
class WornMachine:
    """One plant with its wear, disturbances and reference.

    Attributes
    ----------
    model, plant : Servo
        The machine as twin and edge know it, and as it is.
    gap : SCurve
        rad.
    theta_d0, amplitude, input_bias, friction : float
        rad, m, V, N m.
    delay : int
        Samples, which nobody states.
    """

    model: Servo
    plant: Servo
    gap: SCurve
    theta_d0: float
    amplitude: float
    input_bias: float
    friction: float
    delay: int

    @property
    def scenario(self) -> Scenario:
        """The machine with its twin, as twin and edge know it."""
        return Scenario(
            servo=self.model,
            duration=DURATION,
            reference=SquareWave(self.amplitude, 2.0 * HALF_PERIOD),
            gap=self.gap,
            theta_d0=self.theta_d0,
            recording=Recording(sample_rate=RATE),
            twin=TwinSettings(),
            input_bias=self.input_bias,
            friction=self.friction,
        )

    def simulation(self) -> Simulation:
        """The machine as it is, under the controller that its scenario starts with."""
        return simulation_of(self.scenario, self.plant, self.delay)

    def under(self, controller: Controller, tolerance: float = 0.0) -> Run:
        """Run the machine under one controller from begin to end."""
        simulation = Simulation(
            self.plant,
            DURATION,
            controller=controller,
            reference=SquareWave(self.amplitude, 2.0 * HALF_PERIOD),
            gap=self.gap,
            tolerance=tolerance,
            theta_d0=self.theta_d0,
            sample_rate=RATE,
            input_bias=self.input_bias,
            friction=self.friction,
            delay=self.delay,
        )
        simulation.advance(simulation.samples - 1)
        return simulation.run()


def worn_machines(block: str, count: int, seed: int) -> list[WornMachine]:
    """Draw `count` machines of a block."""
    rng = np.random.default_rng([seed, BLOCKS.index(block)])
    return [_drawn(block, rng) for _ in range(count)]


def _drawn(block: str, rng: np.random.Generator) -> WornMachine:
    def here(name: str) -> bool:
        return block in (name, "all")

    model = Servo.preset("paper").replace(
        sample_rate=RATE,
        voltage_limit=_VOLTAGE_LIMIT if here("saturation") else None,
        position_resolution=RESOLUTION if here("quantisation") else 0.0,
    )
    # All is drawn for every machine, so that the blocks differ by their disturbances only.
    factors = {name: 1.0 + width * rng.uniform(-1.0, 1.0) for name, width in _ERRORS.items()}
    plant = model.replace(**{name: getattr(model, name) * factor for name, factor in factors.items()})
    gap, worn, place = rng.uniform(0.0, _GAPS), rng.uniform(0.0, _WEAR), rng.uniform(-0.5, 0.5)
    bias, stall, delay = rng.uniform(-BIAS, BIAS), rng.uniform(0.0, BIAS), int(rng.integers(1, _DELAY + 1))
    return WornMachine(
        model,
        plant,
        SCurve(gap, gap + worn, DURATION),
        place * gap,
        math.exp(rng.uniform(*np.log(_AMPLITUDES))),
        bias if here("bias") else 0.0,
        stall * plant.k_T / plant.R if here("friction") else 0.0,
        delay if here("delay") else 0,
    )
