"""A stage of steps that moves between two places: its windows do not tell the gap from the lead of its screw."""

import math
from typing import NamedTuple

import numpy as np

from servotwin.cosim import Cosimulation, Loop, SimulatedMachine
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.edge.probe import ProbeLimits
from servotwin.link.simulated import LinkSettings
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.settings import TwinSettings

RATE, HALF_PERIOD = 250.0, 6.0
MAY_PROBE = ExcitationSettings(probe=3e-4)
PROBED = ProbeLimits(3e-4, interval_s=10.0, rest_s=0.5)


class Stage(NamedTuple):
    """A stage: its lead over the stated one, and its gap, rad."""

    ratio: float
    gap: float
    scenario: Scenario

    def run(self) -> Loop:
        """Co-simulate it with its twin, which knows the stated lead."""
        return self.run_with_alarms()[0]

    def run_with_alarms(self) -> tuple[Loop, list[str]]:
        """`run`, and the sentences of the twin's alarms."""
        simulation = simulation_of(self.scenario, self.scenario.model.scaled({"p": self.ratio}))
        running = Cosimulation(self.scenario, SimulatedMachine(self.scenario, simulation))
        while not running.done:
            running.advance()
        return running.loop(simulation.run()), [sentence for _, sentence in running.store.alarms]


def stage(
    seed: tuple[int, int],
    excitation: ExcitationSettings | None = MAY_PROBE,
    probe: ProbeLimits | None = PROBED,
    duration: float = 40.0,
) -> Stage:
    """Draw a stage whose lead is up to 0.6 % off, with a gap of 2 to 20 um and moves of 120 to 400 um."""
    random, axis = np.random.default_rng(seed), Axis.preset("stepper-stage")
    axis = axis.replace(controller=axis.controller.replace(sample_rate=RATE))
    ratio, gap = 1.0 + 0.006 * random.uniform(-1.0, 1.0), random.uniform(2e-6, 20e-6) / axis.p
    amplitude = math.exp(random.uniform(*np.log((60e-6, 200e-6))))
    link = LinkSettings(delay_s=0.1)
    scenario = Scenario(
        servo=axis,
        duration=duration,
        reference=SquareWave(amplitude, 2.0 * HALF_PERIOD),
        gap=gap,
        recording=Recording(sample_rate=RATE, window=1.5 * HALF_PERIOD, pre_trigger=0.95 * HALF_PERIOD, probe=probe),
        uplink=link,
        downlink=link,
        twin=TwinSettings(
            policy="paper",
            k_dz=0.0,
            uncertainty=Uncertainty(gap=(0.0, 30e-6 / axis.p), step=(60e-6, 400e-6)),
            excitation=excitation,
        ),
    )
    return Stage(ratio, gap, scenario)
