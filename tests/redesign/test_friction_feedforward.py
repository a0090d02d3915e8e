"""Known friction is fed forward where that is verified: among the candidates, by cost, and within the edge's limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.control.retuning import law_for_margins
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.attempt import Question
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.margins import loop_margins
from servotwin.redesign.certified.screening import Screening
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
VOLT = SERVO.k_T / SERVO.R
"""N m that a volt stalls."""
DEMANDS = Demands(
    machines=16,
    conditions=4,
    screened=2,
    settled=0.8,
    scales=(0.5, 0.7),
    integral=(0.0, 0.02),
    beyond=Beyond(machines=4),
)
KNOWN = Uncertainty(
    gap=(9.9 * DEG, 10.1 * DEG),
    input_bias=(-2e-4, 2e-4),
    friction=(0.057 * VOLT, 0.063 * VOLT),
    usual_step=(8e-4, 8e-4),
)


def pushes(uncertainty: Uncertainty, demands: Demands = DEMANDS) -> list[float]:
    """Friction feedforwards of the candidates without integral action, and none of the others."""
    candidates = candidates_of(SERVO, uncertainty, demands, True, False)
    assert all(each.controller.friction_feedforward == 0.0 for each in candidates if each.controller.Ki)
    return sorted({each.controller.friction_feedforward for each in candidates})


def test_candidates_feed_forward_the_friction_that_acts_on_every_machine() -> None:
    assert pushes(KNOWN) == pytest.approx([0.0, 0.057])
    assert pushes(KNOWN.replace(friction=(0.0, 0.063 * VOLT))) == [0.0]
    assert pushes(KNOWN, replace(DEMANDS, friction_feedforward=False)) == [0.0]
    assert pushes(KNOWN, replace(DEMANDS, friction_limit=0.02)) == [0.0, 0.02]


@pytest.mark.slow
def test_known_friction_is_fed_forward_and_moves_cost_less() -> None:
    """Simulated beside the certificate, on a machine of the range that moves to and fro."""
    without, fed = (certify(SERVO, KNOWN, replace(DEMANDS, friction_feedforward=push)) for push in (False, True))
    assert isinstance(without, Certificate)
    assert isinstance(fed, Certificate)
    assert fed.setting.controller.friction_feedforward == pytest.approx(0.057)
    errors = []
    for each in (without, fed):
        law, move = each.setting.controller, SquareWave(0.4e-3, 20.0)
        run = simulate(
            SERVO,
            60.0,
            controller=law,
            reference=move,
            gap=10.0 * DEG,
            friction=0.06 * VOLT,
            tolerance=each.setting.tolerance or None,
        )
        errors.append(np.abs(run.reference - run.position)[run.time > 20.0].mean())
    assert errors[1] < 0.8 * errors[0]


def test_a_friction_that_fell_to_nothing_and_a_wrong_direction_leave_the_loop_at_rest() -> None:
    """The push is a constant there, and nothing integrates: an error of at most push / Kp and what friction holds."""
    law = SERVO.controller.replace(Kp=0.6 * SERVO.controller.Kp, Kd=0.6 * SERVO.controller.Kd, Ki=0.0)
    for friction, sign in ((0.0, 1.0), (0.06, 1.0), (0.06, -1.0)):
        fed = law.replace(friction_feedforward=sign * 0.06)
        known = KNOWN.replace(friction=(friction * VOLT, friction * VOLT))
        found = confirm(SERVO, known, Design(fed), replace(DEMANDS, error=1.0, Ms_worst=4.0))
        assert isinstance(found, Certificate)
        assert found.settled == 1.0
        assert found.tail <= 1.02 * (0.06 + friction + 2e-4) / law.Kp


def test_the_largest_steps_refuse_what_the_usual_ones_do_not_show() -> None:
    """Friction holds an overshoot, which grows with the step: a lively law is not ranked before one that passes."""
    demands = replace(DEMANDS, tail=1.5e-5, overshoot=math.inf)
    question = Question(SERVO, KNOWN, demands, trial_for(SERVO, KNOWN, demands), 0.0)
    law = SERVO.controller.replace(Ki=0.0, friction_feedforward=0.057, velocity_feedforward=0.5 * SERVO.k_B / SERVO.p)
    lively = Design(law)
    calm = Design(law.replace(Kp=0.5 * law.Kp, Kd=0.5 * law.Kd, velocity_feedforward=0.0))
    small = replace(question, uncertainty=KNOWN.replace(step=(1e-4, 2e-4), usual_step=(1e-4, 2e-4)))
    assert not Screening(small).fails(lively)
    assert Screening(question).fails(lively)
    assert not Screening(question).fails(calm)


def test_margins_do_not_depend_on_it() -> None:
    law = SERVO.controller.replace(Ki=0.0, friction_feedforward=0.05)
    assert law_for_margins(law) == law_for_margins(law.replace(friction_feedforward=0.0))
    assert loop_margins(SERVO, KNOWN, law) == loop_margins(SERVO, KNOWN, law_for_margins(law))
