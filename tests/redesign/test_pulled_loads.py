"""Loads that a spring or a constant force holds off the reference: integral action is tried without any friction."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import is_pulled_off
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty

PRESET = Axis.preset("ball-screw")
SCREW = PRESET.replace(
    actuator=replace(PRESET.actuator, coulomb=0.0), load=Load((20.0,), (0.0,), (100.0,), friction=0.0)
)
DRIVE = Axis.preset("two-mass-drive")
# N at the load per metre of error, of the screw's own Kp.
HELD = SCREW.pidf.Kp / SCREW.p
KNOWN = Uncertainty(gap=(1.5e-6 / SCREW.p, 15e-6 / SCREW.p), step=(1.5e-4, 1e-3))
DEMANDS = Demands(machines=60, settled=0.95)


def with_load(axis: Axis, **changes: object) -> Axis:
    return axis.replace(load=replace(axis.load, **changes))


@pytest.mark.parametrize("share", [0.3, 0.02, 0.0102, 0.0098, 0.001])
def test_a_spring_counts_where_the_own_gain_leaves_a_hundredth_of_a_step(share: float) -> None:
    """Two springs in series: of a step r the load misses r k / (k + Kp / p)."""
    sprung = with_load(SCREW, k=(HELD * share / (1.0 - share),))
    assert is_pulled_off(sprung, KNOWN) == (share > 0.01)


@pytest.mark.parametrize("share", [0.3, 0.0102, 0.0098])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_counts_beside_the_smallest_step(share: float, sign: float) -> None:
    pushed = with_load(SCREW, force=sign * HELD * share * KNOWN.step[0])
    assert is_pulled_off(pushed, KNOWN) == (share > 0.01)
    assert not is_pulled_off(pushed, KNOWN.replace(step=(0.1, 0.2)))


def test_a_force_that_friction_holds_does_not_count() -> None:
    force = 0.3 * HELD * KNOWN.step[0]
    assert is_pulled_off(with_load(SCREW, force=force, friction=0.9 * force), KNOWN)
    assert not is_pulled_off(with_load(SCREW, force=force, friction=1.1 * force), KNOWN)


def test_a_motor_that_rests_anywhere_is_not_pulled_off() -> None:
    paper = Servo.preset("paper")
    assert not is_pulled_off(paper, Uncertainty())
    telescope = Axis.preset("telescope")
    sprung = with_load(telescope, k=(1e6,), friction=0.0)
    # The drive holds its speed, whatever the load's spring asks of it.
    assert not is_pulled_off(sprung, Uncertainty(step=(1e-4, 1e-3)))


def test_runs_last_until_the_integral_has_done_its_work() -> None:
    own = SCREW.pidf
    sprung = with_load(SCREW, k=(0.3 * HELD,))
    slow = sprung.replace(controller=own.replace(Ki=0.1 * own.Ki))
    # Close to the mode Ki / (Kp + k p) of a slow integral.
    decay = slow.pidf.Ki / (own.Kp + 0.3 * HELD * SCREW.p)
    duration = trial_for(slow, KNOWN.replace(delay=0), DEMANDS).duration
    assert duration >= 12.0 / decay
    assert math.isclose(duration, 12.0 / decay, rel_tol=0.35)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "known"),
    [
        (with_load(SCREW, force=50.0), KNOWN),
        (with_load(SCREW, force=-50.0), KNOWN),
        (with_load(SCREW, k=(0.3 * HELD,)), KNOWN),
        (with_load(DRIVE, k=(20.0,)), Uncertainty(gap=(1e-3, 2e-3), step=(0.01, 0.1))),
    ],
)
def test_a_pulled_load_gets_a_verified_setting_that_integrates(axis: Axis, known: Uncertainty) -> None:
    found = certify(axis, known, DEMANDS)
    assert isinstance(found, Certificate), found
    law = found.setting.controller
    assert getattr(law, "Ki", 0.0) or getattr(law, "integral_time", None)
    assert found.tail < 0.02 * known.step[1] + known.gap[1] * axis.p
