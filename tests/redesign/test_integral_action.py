"""Integral action among the candidates: which of it is tried, and the long runs that show whether it hunts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.plant.actuator import VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.attempt import Attempt, Question
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certify import is_disturbed
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import integral_shares
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.margins import nominal_margins
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

SCREW, DEMANDS = Axis.preset("ball-screw"), Demands()
OWN = SCREW.pidf
KNOWN = Uncertainty(gap=(0.0, 75e-6 / SCREW.p), step=(1.5e-4, 1e-3))


def with_law(servo: Axis, **changes: float) -> Axis:
    return servo.replace(controller=servo.pidf.replace(**changes))


@pytest.mark.parametrize(
    ("servo", "shares"),
    [
        (SCREW, (0.0, 0.1, 0.3, 1.0)),
        (Axis.preset("telescope"), (0.0, 0.1, 0.3, 1.0)),
        # Half the crossover: the paper's loop cycles in every gap with all of it.
        (Servo.preset("paper"), DEMANDS.integral),
        (Axis.preset("robot-joint"), (0.0, 0.1, 0.3, 1.0)),
        (Axis.preset("stepper-stage"), (1.0,)),
    ],
)
def test_an_integral_that_is_slow_beside_the_crossover_is_tried_as_a_whole(
    servo: Plant, shares: tuple[float, ...]
) -> None:
    assert integral_shares(servo, DEMANDS) == shares


def test_what_is_slow_is_a_quarter_of_the_crossover() -> None:
    crossover = nominal_margins(SCREW, OWN.replace(Ki=0.0)).gain_crossovers[-1].omega
    slow, fast = (with_law(SCREW, Ki=share * OWN.Kp * crossover) for share in (0.2, 0.35))
    assert len(integral_shares(slow, DEMANDS)) == 4
    assert integral_shares(slow, DEMANDS) != DEMANDS.integral
    assert integral_shares(fast, DEMANDS) == DEMANDS.integral


def test_a_loop_that_its_integral_alone_makes_stable_keeps_all_of_it_at_all_times() -> None:
    """`tune` finds such gains: Kp and Kd act against one another, and at rest the integral is the only one that pulls.

    Without it every candidate was unstable, and that was the reason of the refusal."""
    drive = Axis(
        VelocityDrive(2.37e-3),
        Transmission(3.15e-4, 5.5e6, 2.3e3, "free"),
        Load((42.5, 42.5), (0.0, 4.5e6), (914.0, 2.3e3)),
        Controller(-1.56e5, 6.26e5, 1.23e5, 0.646, sample_rate=634.0),
    )
    known = Uncertainty(gap=(0.15, 0.35), step=(1.2e-3, 3.4e-3))
    assert integral_shares(drive, DEMANDS, disturbed=False) == (1.0,)
    for disturbed in (False, True):
        candidates = candidates_of(drive, known, DEMANDS, disturbed, noisy=False)
        assert all(each.controller.Ki == drive.pidf.Ki and not each.controller.integral_only for each in candidates)
        assert any(each.controller.Kp == drive.pidf.Kp for each in candidates)
        assert all(nominal_margins(drive, each.controller).stable for each in candidates)


@pytest.mark.parametrize("servo", [SCREW, Axis.preset("gantry")])
def test_zones_that_stop_the_integral_span_the_lost_motion(servo: Axis) -> None:
    known = KNOWN.replace(gap=(0.0, 10.0 * KNOWN.step[0] / servo.p))
    disturbed = is_disturbed(servo, known, DEMANDS, 0.0)
    zone = servo.tolerance_for(known.gap[1])
    found = {
        each.tolerance
        for each in candidates_of(servo, known, DEMANDS, disturbed, noisy=False)
        if isinstance(each.controller, Controller) and each.controller.Ki and each.controller.integral_only
    }
    assert {0.5 * zone, zone} <= found


@cache
def question() -> Question:
    return Question(SCREW, KNOWN, replace(DEMANDS, machines=60, settled=0.95), trial_for(SCREW, KNOWN, DEMANDS), 0.0)


def lively(tolerance: float, leave: float = 2.0) -> Design:
    """The own law with 0.85 times its gain and a zone (m) that stops its integral."""
    law = OWN.replace(Kp=0.85 * OWN.Kp, Kd=0.85 * OWN.Kd, integral_only=tolerance > 0.0, leave=leave)
    return Design(law, tolerance)


@pytest.mark.slow
def test_a_motor_that_friction_holds_may_move_again_much_later() -> None:
    """A machine on which the integral hunts is at rest at the end of the usual run; a zone that stops it keeps it."""
    hunting, resting = Attempt(question(), lively(0.0)), Attempt(question(), lively(8e-6))
    assert hunting._long is not None
    assert resting._long is not None
    assert hunting._long.settled < 1.0
    assert resting._long.settled == 1.0
    # One that hunts on the first few is not simulated on the others.
    assert (hunting._long.machines, resting._long.machines) == (12, 60)
    assert resting._long.duration == pytest.approx(20.0 * question().trial.duration)
    assert "stays at rest" in question().shortcoming(replace(resting.certificate(), long=hunting._long))


def test_long_runs_are_for_an_integral_against_friction_only() -> None:
    plain = Design(OWN.replace(Ki=0.0), 0.0)
    assert Attempt(question(), plain)._long is None
    paper, known = Servo.preset("paper"), Uncertainty(gap=(0.0, 0.1), input_bias=(-0.01, 0.01))
    free = Question(paper, known, DEMANDS, trial_for(paper, known, DEMANDS), 0.0)
    integral = Design(paper.controller.replace(Ki=0.01 * paper.controller.Ki), 0.0)
    assert Attempt(free, integral)._long is None


@pytest.mark.slow
def test_a_zone_lets_an_integral_work_against_friction_on_a_load_that_nothing_holds_in_its_gap() -> None:
    """Without integral action the motor's friction leaves such a load far off; without a zone the integral hunts."""
    joint = Axis.preset("robot-joint")
    gap = 5.25 * np.pi / 180.0 * 5.0
    known = Uncertainty(gap=(0.99 * gap, 1.01 * gap), step=(0.03, 0.17))
    machines = draw_independently(joint, known, 60, 7)
    own, zone = joint.pidf, 0.5 * gap * joint.p
    gentle = own.replace(Kp=0.6 * own.Kp, Kd=0.6 * own.Kd)
    stopped = Design(gentle.replace(integral_only=True, leave=2.0), zone)
    none, hunting = Design(gentle.replace(Ki=0.0)), Design(gentle)
    found = assess([none, hunting, stopped], machines, trial_for(joint, known, DEMANDS))
    assert [each.settled.mean() > 0.95 for each in found] == [True, False, True]
    assert np.percentile(found[2].tail, 95.0) < 0.5 * np.percentile(found[0].tail, 95.0)
    assert np.percentile(found[2].cost, 95.0) < 0.7 * np.percentile(found[0].cost, 95.0)


def test_where_a_candidate_failed_the_next_ones_are_tried_first() -> None:
    own = Attempt(
        replace(question(), uncertainty=KNOWN.replace(gap=(60e-6 / SCREW.p, 75e-6 / SCREW.p))), Design(OWN, 0.0)
    )
    assert own.cannot_pass()
    (machines,) = own.missed()
    assert 0 < machines.count <= 4
    assert own.fails_early([machines])
    calm = Attempt(question(), Design(OWN.replace(Kp=0.6 * OWN.Kp, Kd=0.6 * OWN.Kd, Ki=0.0), 0.0))
    assert not calm.fails_early([machines])
    assert not calm.missed()


def test_where_the_demands_allow_that_a_machine_fails_no_candidate_is_left_out_for_one() -> None:
    wide = KNOWN.replace(gap=(60e-6 / SCREW.p, 75e-6 / SCREW.p))
    strict = Attempt(replace(question(), uncertainty=wide, demands=replace(DEMANDS, machines=300)), Design(OWN, 0.0))
    lenient = Attempt(replace(strict.question, demands=replace(DEMANDS, settled=0.5)), Design(OWN, 0.0))
    for attempt in (strict, lenient):
        attempt.cannot_pass()
    assert strict.missed()
    assert not lenient.missed()


def test_a_machine_that_an_attempt_leaves_swings_in_a_run_of_its_own() -> None:
    """The oracle is the simulation of one machine, with steps to and fro instead of one."""
    own = Attempt(
        replace(question(), uncertainty=KNOWN.replace(gap=(60e-6 / SCREW.p, 75e-6 / SCREW.p))), Design(OWN, 0.0)
    )
    assert own.cannot_pass()
    (machines,) = own.missed()
    trial, gap, size = question().trial, float(machines.gap[0, 0]), float(machines.step[0, 0])
    run = simulate(
        machines.plants[0],
        4.0 * trial.duration,
        controller=OWN,
        reference=SquareWave(0.5 * size, 4.0 * trial.duration),
        gap=gap,
        sample_rate=OWN.sample_rate,
    )
    last = (run.reference - run.position)[-len(run.time) // 6 :]
    assert 0.5 * np.ptp(last) > 0.02 * SCREW.p * gap
