"""Friction that an axis states is known to a share only: of machines, candidates, limits, and in the certificate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servotwin.commissioning.guarding import certified_limits
from servotwin.control.gains import gains_of
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import arrival_error, assess, nearness
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certify import confirm
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw, draw_independently, extreme_plants
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

GANTRY, SERVO, POSITIONER = Axis.preset("gantry"), Servo.preset("paper"), Axis.preset("micro-positioner")
KNOWN = Uncertainty(gap=(2e-4 / GANTRY.p, 3e-4 / GANTRY.p), step=(1.5e-3, 1e-2))
SMALL = Uncertainty(gap=(1e-6 / POSITIONER.p, 2e-6 / POSITIONER.p), step=(6e-6, 4e-5))
FEW = Demands(machines=12, settled=0.7, beyond=Beyond(machines=4))


def test_friction_of_motor_and_load_is_scaled_with_what_holds_at_standstill() -> None:
    load, motor = replace(GANTRY.load, static=400.0, stribeck=1e-3), replace(GANTRY.actuator, static=0.8, stribeck=1.0)
    sticky = GANTRY.replace(load=load, actuator=motor).scaled({"motor_friction": 0.5, "load_friction": 1.5})
    assert (sticky.actuator.coulomb, sticky.actuator.static) == (0.25, 0.4)
    assert (sticky.load.friction, sticky.load.static) == (450.0, 600.0)
    assert sticky.own_friction == pytest.approx(0.4 + GANTRY.p * 600.0)
    telescope = Axis.preset("telescope")
    assert telescope.scaled({"motor_friction": 0.5}) == telescope


def test_machines_have_friction_about_the_models_and_those_of_a_servo_are_as_before() -> None:
    for machines in (draw(GANTRY, KNOWN, 64, 1), draw_independently(GANTRY, KNOWN, 400, 3)):
        motor = np.array([plant.motor_friction for plant in machines.plants]) / GANTRY.motor_friction
        load = np.array([plant.load.friction for plant in machines.plants]) / GANTRY.load.friction
        for factors in (motor, load):
            assert 0.75 <= factors.min() < 0.8
            assert 1.2 < factors.max() <= 1.25
        assert abs(np.corrcoef(motor, load)[0, 1]) < 0.2
        own = [plant.own_friction for plant in machines.plants]
        assert machines.own_friction.ravel() == pytest.approx(own)
    exact = draw_independently(GANTRY, KNOWN.replace(own_friction=0.0), 8, 3)
    assert {plant.own_friction for plant in exact.plants} == {GANTRY.own_friction}
    wide, narrow = (draw_independently(SERVO, Uncertainty(own_friction=each), 8, 3) for each in (0.5, 0.0))
    assert wide.plants == narrow.plants
    assert np.array_equal(wide.step, narrow.step)
    # Friction is no part of a linear loop.
    assert {plant.own_friction for plant in extreme_plants(GANTRY, KNOWN, 4, 0)} == {GANTRY.own_friction}


def test_a_machine_has_arrived_where_its_own_friction_may_hold_it() -> None:
    machines, calm = draw_independently(GANTRY, KNOWN, 16, 5), Design(GANTRY.controller.replace(Ki=0.0))
    near = nearness(calm, machines, machines.step).ravel()
    each = [
        float(arrival_error(calm, GANTRY, bias, plant.own_friction, step))
        for plant, bias, step in zip(machines.plants, machines.input_bias.ravel(), machines.step.ravel(), strict=True)
    ]
    assert near == pytest.approx(each)


@pytest.mark.slow
def test_the_least_friction_is_fed_forward_and_edges_take_it_where_no_bias_is_stated() -> None:
    own = POSITIONER.command_of(POSITIONER.own_friction)
    for width in (0.0, 0.25):
        pushes = {
            each.controller.friction_feedforward
            for each in candidates_of(POSITIONER, SMALL.replace(own_friction=width), Demands(), True, False)
        }
        assert sorted(pushes) == pytest.approx([0.0, (1.0 - width) * own])
    policy = CertifiedPolicy(POSITIONER, SMALL, FEW, feedforward_limit=0.0)
    assert policy.friction_feedforward_limit == pytest.approx(own)
    limits, centre = certified_limits(policy), gains_of(POSITIONER.controller)
    fed = gains_of(POSITIONER.controller.replace(Ki=0.0, friction_feedforward=0.75 * own))
    assert limits.allows_gains(fed, centre)
    assert not limits.allows_gains(gains_of(POSITIONER.controller.replace(friction_feedforward=1.1 * own)), centre)


def test_the_certificate_says_how_far_the_friction_was_off() -> None:
    calm = Design(POSITIONER.controller)
    found = confirm(POSITIONER, SMALL, calm, FEW)
    certificate = getattr(found, "best", found)
    assert certificate.own_friction == 0.25
    assert "motor and load with friction up to 25 % off the model's" in certificate.tried(POSITIONER)
    assert "friction up to" not in replace(certificate, own_friction=0.0).tried(POSITIONER).split("; beyond that")[0]
    with pytest.raises(InvalidInput, match="own_friction"):
        Uncertainty(own_friction=1.0)


def test_a_feedforward_of_all_the_friction_costs_more_than_said_where_it_is_less() -> None:
    """What a verification on exactly known friction would hide."""
    law = POSITIONER.controller.replace(
        Ki=0.0, friction_feedforward=POSITIONER.command_of(POSITIONER.own_friction), notch_hz=0.0
    )
    exact, off = (
        assess([Design(law)], draw_independently(POSITIONER, known, 24, 1), trial_for(POSITIONER, known, FEW))[0]
        for known in (SMALL.replace(own_friction=0.0), SMALL)
    )
    assert np.percentile(off.cost, 95.0) > 2.0 * np.percentile(exact.cost, 95.0)


def test_each_machine_is_simulated_with_its_own_friction() -> None:
    known = KNOWN.replace(own_friction=0.5)
    machines, trial = draw_independently(GANTRY, known, 3, 7), trial_for(GANTRY, known, FEW)
    (together,) = assess([Design(GANTRY.controller)], machines, trial)
    rate = GANTRY.controller.sample_rate
    assert rate is not None
    for place, plant in enumerate(machines.plants):
        gap, step, screw = (float(getattr(machines, name)[place, 0]) for name in ("gap", "step", "theta_d0"))
        run = simulate(plant, trial.duration, reference=step, gap=gap, theta_d0=screw, sample_rate=rate)
        last = np.abs(run.reference - run.position)[:: round(rate / trial.rate)][-round(trial.last * trial.rate) :]
        assert last.max() == pytest.approx(together.tail[place, 0], abs=1e-9 * step)
