"""Certificates in other units of time, length and voltage, and stored ones of the version before."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import msgspec
import pytest
from scaling import scaled

from servotwin.plant.servo import Servo
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import decoded_part

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
SMALL = Demands(
    machines=16, conditions=4, screened=2, settled=0.8, scales=(0.5, 0.7), integral=(0.0,), beyond=Beyond(machines=4)
)
NARROW = Uncertainty(gap=(9.9 * DEG, 10.1 * DEG), input_bias=(-2e-4, 2e-4))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time", "length", "voltage"),
    [(1e-3, 1.0, 1.0), (1e3, 1.0, 1.0), (1.0, 1e-6, 1.0), (1.0, 1e6, 1.0), (1.0, 1.0, 1e-2), (10.0, 1e-3, 1e2)],
)
def test_another_unit_changes_no_verdict_and_scales_the_setting(time: float, length: float, voltage: float) -> None:
    here = certify(SERVO, NARROW, SMALL)
    there = certify(
        scaled(SERVO, time, length, voltage),
        NARROW.replace(
            step=tuple(length * end for end in NARROW.step),
            input_bias=tuple(voltage * end for end in NARROW.input_bias),
        ),
        SMALL,
    )
    assert isinstance(here, Certificate)
    assert isinstance(there, Certificate)
    law, other = here.setting.controller, there.setting.controller
    assert other.Kp == pytest.approx(law.Kp * voltage / length, rel=1e-9)
    assert other.Kd == pytest.approx(law.Kd * voltage * time / length, rel=1e-9)
    assert other.Tf == pytest.approx(law.Tf * time, rel=1e-9)
    assert there.Ms == pytest.approx(here.Ms, rel=1e-6)
    assert there.loop is not None
    assert here.loop is not None
    assert there.loop.Ms_worst == pytest.approx(here.loop.Ms_worst, rel=1e-6)
    assert there.looked_at == here.looked_at


@pytest.mark.parametrize("time", [1e-2, 10.0])
def test_a_slower_or_faster_servo_has_a_fallback_set(time: float) -> None:
    servo = scaled(SERVO, time, 1.0, 1.0)
    known = Uncertainty(input_bias=(-0.1, 0.1))
    assert isinstance(certify(servo, known, replace(SMALL, scales=(0.5,), shapes=((1.5, 0.85),))), Certificate)
    assert trial_for(servo, known, Demands()).duration == pytest.approx(
        time * trial_for(SERVO, known, Demands()).duration, rel=1e-6
    )


# --- stored ones


def test_a_certificate_of_the_version_before_is_read() -> None:
    found = certify(SERVO, NARROW, SMALL)
    assert isinstance(found, Certificate)
    new = ("settled_least", "confidence", "loop", "beyond", "ramp", "rate", "delay", "error_per_volt", "lag")
    document = {name: value for name, value in msgspec.to_builtins(found).items() if name not in new}
    read = msgspec.convert(document, Certificate, dec_hook=decoded_part)
    assert read.loop is None
    assert all(getattr(read, f.name) == getattr(found, f.name) for f in fields(read) if f.compare and f.name not in new)
