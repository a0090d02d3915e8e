"""Demands of a certified twin for tests that are not about how often a setting was tried."""

from servotwin.cosim.scenario import Scenario
from servotwin.redesign.certified.demands import Demands

FEW = Demands(machines=16, screened=2, scales=(0.5, 0.7), settled=0.8, notch=False, velocity_feedforward=False)
"""Settings verified on fewer machines than usual, from fewer candidates."""


def certified_scenario(duration: float) -> Scenario:
    """The packaged scenario `certified`, so long (s), with few machines."""
    scenario = Scenario.preset("certified").replace(duration=duration)
    return scenario.replace(twin=scenario.twin.replace(demands=FEW))
