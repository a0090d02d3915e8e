"""The predicted effect of an update on machines that differ from their model: band and verification as learnt."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from servotwin.control.gains import with_gains
from servotwin.edge.watch import Watch, WatchSettings
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.messages import Setting, Update
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.learnt_servo import learnt_servo, narrowed
from servotwin.redesign.certified.lookup import CellIndex, CertifiedTable, Grid, TablePolicy, certify_cell
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.policy import Evidence
from servotwin.simulation import simulate
from servotwin.twin.lookups import Lookups, LookupState, VerificationRequest, decode_request, encode_request

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
DEMANDS = Demands(
    machines=16, conditions=4, screened=2, settled=0.8, scales=(0.5, 0.7), integral=(0.0,), beyond=Beyond(machines=4)
)
POLICY = CertifiedPolicy(SERVO, Uncertainty(gap=(0.0, 20.0 * DEG), input_bias=(-0.1, 0.1)), DEMANDS, clock=lambda: 0.0)
OFF_BY = ((1.05, 1.3, 1.01, 1.0), (0.95, 0.7, 0.99, 1.0))
"""Factors on stiffness, damping, pitch and mass ratio."""
BIAS, GAP = 0.04, 10.0 * DEG


def learnt(factors: tuple[float, ...]) -> FactorPrior:
    return FactorPrior(np.log(factors), np.diag(np.square([5e-4, 3e-3, 2e-4, 1e-3])))


def evidence(machine: FactorPrior | None = None) -> Evidence:
    spread = 0.02 * DEG
    estimate = GapEstimate(GAP, spread, spread, (GAP - spread, GAP + spread), GapStatus.OK, 1.0)
    return Evidence(estimate, Disturbance(BIAS, 1e-5, 0.0, 0.3, 0.0), machine=machine, rests=(BIAS, BIAS))


def watched(plant: Servo, setting: Setting) -> bool:
    """True where the edge's watch lets the setting run on a machine for four steps."""
    assert setting.gains is not None
    law = with_gains(SERVO.controller, setting.gains)
    run = simulate(
        plant, 80.0, controller=law, reference=SquareWave(1e-3, 40.0), gap=GAP, tolerance=setting.tolerance,
        input_bias=BIAS, sample_rate=1000.0,
    )  # fmt: skip
    watch = Watch(WatchSettings(margin=1.0), run.sample_rate)
    watch.restart(setting.band, 0)
    whole = len(run.time) // watch.slot * watch.slot
    parts = (run.reference[:whole].tolist(), run.position[:whole].tolist(), run.voltage[:whole].tolist())
    return watch.update(0, *parts) is None and watch.verified


@pytest.mark.slow
@pytest.mark.parametrize("factors", OFF_BY)
def test_a_learnt_machine_stays_in_the_band_that_is_predicted_on_it(factors: tuple[float, ...]) -> None:
    plant, before = adapted(SERVO, np.log(factors)), POLICY.redesign(evidence())
    after = POLICY.redesign(evidence(learnt(factors)))
    assert before.certificate is not None
    assert after.certificate is not None
    assert after.setting is not None
    law = after.certificate.setting.controller.replace(feedforward=0.0, enter=1.0, leave=1.0)
    assert after.certificate.Ms == pytest.approx(plant.margins(law).Ms, rel=1e-9)
    assert watched(plant, after.setting)
    assert after.setting.band is not None
    tight = msgspec.structs.replace(after.setting.band, effort=0.5 * BIAS)
    assert not watched(plant, msgspec.structs.replace(after.setting, band=tight))


def test_the_pitch_counts_with_its_covariance() -> None:
    covariance = np.diag(np.square([5e-4, 3e-3, 0.01, 1e-3]))
    covariance[0, 2] = covariance[2, 0] = 0.5 * 5e-4 * 0.01
    made = learnt_servo(SERVO, POLICY.uncertainty, FactorPrior(np.log(OFF_BY[0]), covariance), None)
    assert made is not None
    servo, factors = made
    assert servo.p == pytest.approx(1.01 * SERVO.p)
    assert factors.names == ("k", "c", "p")
    assert factors.covariance[2][2] == covariance[2, 2]
    assert factors.covariance[0][2] == covariance[0, 2]


def test_of_a_free_shaft_the_stiffness_over_the_mass_counts() -> None:
    """The load's mass and its dampings stay as stated: both act on the loop, and are not learnt."""
    axis, known = Axis.preset("gantry"), POLICY.uncertainty
    made = learnt_servo(axis, known, learnt(OFF_BY[0]), None)
    assert made is not None
    machines = draw_independently(made[0], narrowed(known, made[1]), 400, 1).plants
    shafts = [each for each in machines if isinstance(each, Axis)]
    mass = np.array([each.load.m[0] for each in shafts]) / axis.load.m[0]
    over_mass = np.array([each.transmission.k_d for each in shafts]) / axis.transmission.k_d / mass
    assert np.all(np.abs(over_mass / OFF_BY[0][0] - 1.0) < 0.02)
    assert np.ptp(mass) > 1.9 * known.m
    assert np.ptp([each.transmission.c_d for each in shafts]) > 1.9 * known.c * axis.transmission.c_d


def test_a_free_shaft_that_is_hardly_known_or_has_another_load_keeps_its_stated_ranges() -> None:
    axis, known = Axis.preset("gantry"), POLICY.uncertainty
    unknown = FactorPrior(np.zeros(4), np.diag(np.square([0.08, 0.3, 0.01, 0.01])))
    assert learnt_servo(axis, known, unknown, None) is None
    m = axis.load.m[0]
    sprung = axis.replace(load=replace(axis.load, m=(0.5 * m, 0.5 * m), k=(0.0, 1e8), c=(*axis.load.c, 1e3)))
    assert learnt_servo(sprung, known, learnt(OFF_BY[0]), None) is None
    assert learnt_servo(Axis.preset("robot-joint"), known, learnt(OFF_BY[0]), None) is None  # it floats in the gap


@cache
def table() -> TablePolicy:
    """A table of one cell: the whole stated range of gaps, 50 mV of bias."""
    grid = Grid(finest=20.0 * DEG, biases=(5e-2,), noises=(0.0,))
    key = CellIndex(0, 0, 0, 0)
    known = POLICY.uncertainty
    cells = {key: certify_cell(POLICY, grid, key)}
    assert cells[key] is not None
    return TablePolicy(
        POLICY,
        CertifiedTable(grid, known.gap, known.friction, POLICY.feedforward_limit, 5e-2, POLICY.fallback(), cells),
    )


@pytest.mark.slow
def test_a_machine_outside_of_the_stated_half_widths_is_verified_before_anything_is_sent() -> None:
    inside, outside = (table().redesign(evidence(learnt(each))) for each in (OFF_BY[0], (1.5, 1.3, 1.0, 1.0)))
    assert inside.to_verify is not None
    assert outside.to_verify is None
    assert outside.certificate is not None
    machine = adapted(SERVO, np.log([1.5, 1.3, 1.0, 1.0]))
    law = outside.certificate.setting.controller.replace(feedforward=0.0, enter=1.0, leave=1.0)
    assert outside.certificate.Ms == pytest.approx(machine.margins(law).Ms, rel=1e-9)


def request_of(machine: FactorPrior | None) -> VerificationRequest:
    given = evidence(machine)
    redesign = table().redesign(given)
    assert redesign.setting is not None
    update = Update("axis", 1, 0, ("b", 1), 0.0, GAP, 1e-3, (0.1, 0.2), "ok", redesign.setting, 60.0)
    made = VerificationRequest.of(update, redesign, given)
    assert made is not None
    return made


def test_a_setting_that_was_looked_up_is_verified_on_the_learnt_machine() -> None:
    plain, known = request_of(None), request_of(learnt(OFF_BY[0]))
    assert b"machine" not in encode_request(plain)
    assert decode_request(encode_request(known)) == known
    before = encode_request(known).replace(b"\xb6verification-request/1", b"\xa7proof/1")
    assert before != encode_request(known)
    assert decode_request(before) == known
    lookups = Lookups(table())
    results = [lookups.verify(LookupState(), each, [each.setting.setting()])[1] for each in (plain, known)]
    assert all(isinstance(one, Certificate) for one in results)
    law = known.setting.controller.replace(feedforward=0.0, enter=1.0, leave=1.0)
    assert results[0].Ms == pytest.approx(SERVO.margins(law).Ms, rel=1e-9)
    assert results[1].Ms == pytest.approx(adapted(SERVO, np.log(OFF_BY[0])).margins(law).Ms, rel=1e-9)
