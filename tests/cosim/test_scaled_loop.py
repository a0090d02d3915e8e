"""The whole loop, edge and twin, on the same machine in other units: the same messages, gaps and settings."""

import dataclasses
import math
from functools import cache

import pytest
from scaling import Units, scaled

from servotwin.commissioning.edge_settings import Recording
from servotwin.cosim import cosimulate
from servotwin.cosim.loop import Loop
from servotwin.cosim.scenario import Scenario
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.settings import TriageSettings, TwinSettings

SERVO = Servo.preset("paper")


@cache
def loop(units: Units) -> Loop:
    """Four steps with a gap that grows; what a file states (wall-clock times, ranges) is in the other units."""
    steps = Uncertainty(step=(1e-4 * units.length, 2.5e-3 * units.length))
    twin = TwinSettings(
        policy="paper",
        uncertainty=dataclasses.replace(steps, input_bias=(-0.1 * units.voltage, 0.1 * units.voltage)),
        excitation=ExcitationSettings(),
        learning=LearningSettings(k_drift=0.0, c_drift=0.0),  # the default is per day
        triage=TriageSettings(longest=3600.0 * units.time),
    )
    return cosimulate(
        Scenario(
            servo=scaled(SERVO, *units),
            duration=34.0 * units.time,
            reference=SquareWave(1e-3 * units.length, 20.0 * units.time),
            gap=SCurve(math.radians(4.0), math.radians(6.0), duration=34.0 * units.time),
            recording=Recording(sample_rate=1024.0 / units.time),
            twin=twin,
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("units", [Units(time=2.0**-8), Units(2.0**8, 2.0**-20, 2.0**7)])
def test_edge_and_twin_do_the_same_on_a_machine_in_other_units(units: Units) -> None:
    here, there = loop(Units()), loop(units)
    assert len(there.windows) == len(here.windows) == 4
    assert [one.status for one in there.estimates] == [one.status for one in here.estimates]
    assert [one.gap for one in there.estimates] == pytest.approx([one.gap for one in here.estimates], rel=1e-4)
    tolerances = [update.setting.tolerance / units.length for update in there.updates]
    assert tolerances == pytest.approx([update.setting.tolerance for update in here.updates], rel=1e-4)
    assert tolerances
    assert there.run.position[-1] / units.length == pytest.approx(here.run.position[-1], abs=1e-5)
