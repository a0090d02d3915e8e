"""Decisions of the certified policy as workloads: from the uncertainty to a setting verified on 300 machines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.contest import Contestant
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import LearntFactors, Uncertainty

KNOWN_BIAS, UNKNOWN_BIAS = (-2e-4, 2e-4), (-0.1, 0.1)  # V
NARROW, WIDE, WHOLE = (9.9, 10.1), (39.9, 40.1), (0.0, 60.0)  # deg
RATE, COUNTS = 5e3, 1e-6  # Hz, m rms of the encoder
COUNT = 1e-6  # m, of a position sensor that counts
# Posterior of a machine that has been learnt, and the step that it makes to and fro.
LEARNT = LearntFactors(("k", "c"), (0.01, 0.1), ((9e-6, 0.0), (0.0, 9e-4)))
USUAL_STEP = (1e-3, 1e-3)  # m
FRICTION = 0.05  # V, of the motor


def decisions(quick: bool) -> tuple[Contestant, ...]:
    """Narrow gaps with a known input bias and the whole stated range, continuous and at 5 kHz; `quick`: fewer and
    shorter runs.

    At 5 kHz also a machine that has been learnt and moves to and fro, an input bias that is not known, friction, and a
    position sensor that counts.
    """
    servo = Servo.preset("paper")
    fast = servo.replace(controller=servo.controller.replace(sample_rate=RATE))
    narrow, whole = _known(NARROW, KNOWN_BIAS), _known(WHOLE, UNKNOWN_BIAS)
    moving, torque = narrow.replace(learnt=LEARNT, usual_step=USUAL_STEP), FRICTION * servo.k_T / servo.R
    return (
        _decision("gap of 10 deg", servo, narrow, quick),
        _decision("gap of 40 deg", servo, _known(WIDE, KNOWN_BIAS), quick),
        _decision("fallback set", servo, whole, quick),
        _decision("gap of 10 deg, 5 kHz", fast, narrow, quick),
        _decision("learnt, to and fro, 5 kHz", fast, moving, quick, COUNTS),
        _decision("bias not known, 5 kHz", fast, _known(NARROW, UNKNOWN_BIAS), quick, COUNTS),
        _decision("friction, 5 kHz", fast, narrow.replace(friction=(0.4 * torque, torque)), quick),
        _decision("fallback set, 5 kHz", fast, whole, quick),
        _decision("counts of 1 um, 5 kHz", fast.replace(position_resolution=COUNT), narrow, quick),
    )


def _known(gap_deg: tuple[float, float], bias: tuple[float, float]) -> Uncertainty:
    return Uncertainty(gap=(math.radians(gap_deg[0]), math.radians(gap_deg[1])), input_bias=bias)


def _decision(name: str, servo: Servo, known: Uncertainty, quick: bool, noise: float = 0.0) -> Contestant:
    demands = Demands()
    if quick:
        demands = replace(demands, machines=16, conditions=4, screened=2, settled=0.8)
    trial = trial_for(servo, known, demands)

    def job() -> Array:
        result = certify(servo, known, demands, trial, noise=noise)
        settled = result.settled if isinstance(result, Certificate) else 0.0
        return np.array([settled, result.members if isinstance(result, Certificate) else 0.0])

    return Contestant(name, lambda: job)
