"""Settings of cascades whose own gains are far beyond the bounds on Ms: slower ones that keep their integral."""

from __future__ import annotations

import numpy as np
import pytest
from worm_table import WORM_TABLE

import servotwin as st
from servotwin.commissioning.edge_settings import Commissioning
from servotwin.control.gains import gains_of
from servotwin.control.retuning import integrates, slowed
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.twin.settings import TwinSettings

KNOWN = Uncertainty(gap=(0.0, 0.2), step=(0.035, 0.07), input_bias=(-0.08, 0.08))
FEW = Demands(machines=16, settled=0.8, beyond=Beyond(machines=4), attempts=2)
FEWER = Demands(machines=6, screened=2, conditions=4, settled=0.6, beyond=Beyond(machines=4), attempts=2)
"""The same candidates: the fallback set, which only bounds their dead zones, is verified on fewer machines."""


def test_a_slower_cascade_keeps_the_phases_of_a_rigid_axis_at_its_crossovers() -> None:
    own = WORM_TABLE.controller
    assert isinstance(own, st.Cascade)
    omega = np.array([3.0, 30.0, 300.0])

    def loop(law: st.Cascade, at: np.ndarray) -> np.ndarray:
        """Velocity loop of an inertia of 1 kg m^2, and the position loop around it."""
        assert law.velocity_gain is not None
        assert law.integral_time is not None
        s = 1j * at
        velocity = law.velocity_gain * (1.0 + 1.0 / (law.integral_time * s)) / s
        return np.stack([velocity, law.position_gain / s * velocity / (1.0 + velocity)])

    assert loop(slowed(own, 0.3), 0.3 * omega) == pytest.approx(loop(own, omega))


@pytest.mark.slow
def test_slower_cascades_are_tried_with_their_integral_where_the_own_gains_are_out_of_bounds() -> None:
    laws = [each.controller for each in candidates_of(WORM_TABLE, KNOWN, FEW, disturbed=True, noisy=False)]
    assert any(integrates(law) for law in laws)
    undisturbed = candidates_of(WORM_TABLE, KNOWN, FEW, disturbed=False, noisy=False)
    assert not any(integrates(each.controller) for each in undisturbed)


@pytest.mark.slow
def test_the_edge_admits_every_slower_cascade() -> None:
    own, twin = WORM_TABLE.controller, TwinSettings(policy="certified", uncertainty=KNOWN, demands=FEWER)
    guarded = Commissioning(WORM_TABLE, own, twin).guarding
    assert guarded is not None
    designs = candidates_of(WORM_TABLE, KNOWN, FEWER, disturbed=True, noisy=False)
    assert all(guarded.limits.allows_gains(gains_of(each.controller), gains_of(own)) for each in designs)


@pytest.mark.slow
def test_a_table_behind_a_worm_gear_has_a_setting_that_takes_away_what_friction_leaves() -> None:
    """Without it none is: friction and bias hold the slow loop farther away than a step is long."""
    found = certify(WORM_TABLE, KNOWN, FEW)
    assert isinstance(found, Certificate)
    fresh = draw_independently(WORM_TABLE, KNOWN, 40, 30112026)
    (setting,) = assess([found.setting], fresh, trial_for(WORM_TABLE, KNOWN, FEW))
    assert setting.settled.mean() >= 0.9
    assert float(setting.tail.max()) <= 1e-3 * KNOWN.step[0]
