"""The edge's box of every preset: it admits the gains of all candidates, and none beyond them."""

import dataclasses
import math

import numpy as np
import pytest
from msgspec.structs import replace

from benchmarks.preset_machines import DUTIES, stated_ranges
from servotwin.commissioning.guarding import certified_limits
from servotwin.control.gains import gains_of
from servotwin.estimation.learning.machine import nameplate
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import AnyGains
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.learnt_servo import learnt_servo, narrowed
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import PARAMETERS, LearntFactors
from servotwin.redesign.registry import certified_policy
from servotwin.twin.settings import TwinSettings

SERVOS = ("paper", "table1", "paper-gain2")
# Its loop does not depend on the gap.
AXES = [name for name in DUTIES if name != "emps"]
FEW = Demands(machines=6, screened=2, conditions=4, settled=0.6, beyond=Beyond(machines=4))
"""All candidates, but the fallback set that bounds their dead zones is verified on fewer machines than usual."""


def policy_of_preset(name: str) -> CertifiedPolicy:
    if name in SERVOS:
        return certified_policy(Servo.preset(name), TwinSettings(demands=FEW))
    return certified_policy(Axis.preset(name), TwinSettings(demands=FEW, uncertainty=stated_ranges(name)))


def sent(policy: CertifiedPolicy) -> list[AnyGains]:
    """Gains of the candidates for the stated ranges, and for machines that are learnt exactly and more or less well."""
    demands, known, servo = policy.demands_within_band(), policy.uncertainty, policy.servo
    exact = known.replace(**dict.fromkeys(PARAMETERS, 0.0), learnt=LearntFactors(("k",), (0.0,), ((0.0,),)))
    found = candidates_of(servo, known, demands, True, False)
    found += candidates_of(servo, exact, dataclasses.replace(demands, beyond=Beyond(k_T=0.0)), True, False)
    first = nameplate(TwinSettings().learning, known.k, known.c, known.m)
    for end, share in ((0.0, 0.03), (-1.0, 0.5), (1.0, 0.5), (-1.0, 0.9)):
        # The less is learnt of a machine, the less can it have been found to be off.
        off = end * math.sqrt(1.0 - share**2)
        mean = np.log1p(off * np.array([known.k, known.c, 0.0, 0.0]))
        learnt = learnt_servo(servo, known, FactorPrior(mean, first.covariance * share**2), None)
        if learnt is not None:
            found += candidates_of(learnt[0], narrowed(known, learnt[1]), demands, True, False)
    return [gains_of(each.controller) for each in found]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SERVOS, *AXES])
def test_the_box_of_a_preset_admits_the_gains_of_its_candidates_and_none_beyond(name: str) -> None:
    policy = policy_of_preset(name)
    limits, own, gains = certified_limits(policy), gains_of(policy.servo.controller), sent(policy)
    assert all(limits.allows_gains(each, own) for each in gains)
    for each in (each for each in own.scaled if getattr(own, each)):
        values = [getattr(one, each) for one in gains]
        lowest, highest = min(values, key=abs), max(values, key=abs)
        for beyond in (0.99 * lowest, 1.01 * highest):
            assert not limits.allows_gains(replace(gains[0], **{each: beyond}), own), (each, beyond)
