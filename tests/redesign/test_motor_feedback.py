"""Verified settings of axes whose controller reads the motor's encoder, with a gap behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.assess import assess, nearness, unseen_error
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify, is_disturbed
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.integral_action import integral_shares
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate


def on_motor(name: str) -> Axis:
    axis = Axis.preset(name)
    return axis.replace(sensors=replace(axis.sensors, feedback="motor"))


GANTRY = on_motor("gantry")
KNOWN = Uncertainty(gap=(2e-4 / GANTRY.p, 3e-4 / GANTRY.p), step=(1.5e-3, 1e-2))


def test_the_load_rests_within_what_the_motor_does_not_see() -> None:
    """The oracle is the simulated machine: reference less load, and reference less motor, after steps to and fro."""
    law, gap = GANTRY.pidf.replace(Ki=0.0), 3e-4 / GANTRY.p
    run = simulate(GANTRY, 40.0, controller=law, reference=SquareWave(2e-3, 20.0), gap=gap, sample_rate=law.sample_rate)
    apart = (GANTRY.p * run.theta_m - run.position)[[len(run.time) // 4 - 1, len(run.time) // 2 - 1, -1]]
    most = float(unseen_error(GANTRY, gap))
    assert most == pytest.approx(1.5e-4 + GANTRY.load.friction / GANTRY.transmission.k_d)
    assert np.all(np.abs(apart) <= most)
    assert np.abs(apart).max() > 0.5 * 1.5e-4


def test_nothing_is_unseen_where_the_controller_reads_the_load() -> None:
    load = Axis.preset("gantry")
    assert unseen_error(load, 0.1) == 0.0
    members = draw_independently(load, KNOWN, 8, 1)
    behind = draw_independently(GANTRY, KNOWN, 8, 1)
    design = Design(GANTRY.pidf, 0.0)
    more = nearness(design, behind, behind.step) - nearness(design, members, members.step)
    counts = 2.0 * (GANTRY.position_resolution - load.position_resolution)
    unseen = [unseen_error(plant, gap) for plant, gap in zip(behind.plants, members.gap, strict=True)]
    assert more == pytest.approx(counts + np.stack(unseen))
    # A quarter more of the load's friction winds the shaft up by a quarter more.
    wind_up = GANTRY.load.friction / GANTRY.transmission.k_d
    assert unseen_error(GANTRY, 0.1, 1.25) - unseen_error(GANTRY, 0.1) == pytest.approx(0.25 * wind_up)


def test_the_motors_error_has_no_zone_of_the_lost_motion_and_its_integral_acts_before_the_gap() -> None:
    disturbed = is_disturbed(GANTRY, KNOWN, Demands(), 0.0)
    lost = GANTRY.tolerance_for(KNOWN.gap[1])
    zones = {each.tolerance for each in candidates_of(GANTRY, KNOWN, Demands(), disturbed, noisy=True)}
    assert not zones & {0.5 * lost, lost}
    assert integral_shares(on_motor("robot-joint"), Demands()) == (0.0, 0.1, 0.3, 1.0)


def test_a_shorter_filter_is_tried_where_the_bounds_leave_less_than_half_of_the_own_gain() -> None:
    """The derivative action of `robot-joint` lags at the resonance of its shaft, that of `gantry` does not."""
    joint = on_motor("robot-joint")
    known = Uncertainty(gap=(0.0, 0.1), step=(0.03, 0.15))
    for axis, short in ((joint, True), (GANTRY, False)):
        laws = [each.controller for each in candidates_of(axis, known, Demands(), disturbed=True, noisy=False)]
        fastest = max(laws, key=lambda law: law.Kp)
        assert (fastest.Tf < 0.5 * axis.pidf.Tf) == short
    load = Axis.preset("robot-joint")
    laws = [each.controller for each in candidates_of(load, known, Demands(), disturbed=True, noisy=False)]
    assert min(law.Tf for law in laws) > 0.5 * load.pidf.Tf


@pytest.mark.slow
def test_a_robot_joint_that_reads_its_motor_has_a_setting_that_rests_on_fresh_machines() -> None:
    joint = on_motor("robot-joint")
    known = Uncertainty(gap=(0.4, 0.5), step=(0.03, 0.17))
    demands = Demands(machines=60, settled=0.95, beyond=Beyond(machines=20))
    found = certify(joint, known, demands)
    assert isinstance(found, Certificate)
    fresh = draw_independently(joint, known, 60, 987)
    (setting,) = assess([found.setting], fresh, trial_for(joint, known, demands))
    assert setting.settled.mean() >= 0.95
    assert found.loop is not None
    assert found.loop.Ms_worst <= demands.Ms_worst


@pytest.mark.slow
def test_a_setting_of_a_semi_closed_loop_is_verified_and_rests_on_machines_of_its_own() -> None:
    demands = Demands(machines=60, settled=0.95, beyond=Beyond(machines=20))
    found = certify(GANTRY, KNOWN, demands)
    assert isinstance(found, Certificate)
    fresh = draw_independently(GANTRY, KNOWN, 60, 987)
    own, setting = assess([Design(GANTRY.controller, 0.0), found.setting], fresh, trial_for(GANTRY, KNOWN, demands))
    assert setting.settled.mean() >= 0.95
    assert setting.settled.sum() >= own.settled.sum()
    assert float(setting.tail.max()) > 0.4 * GANTRY.p * KNOWN.gap[0]
