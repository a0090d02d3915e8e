"""Decisions of the certified policy as workloads: from the uncertainty to a setting verified on 256 machines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.contest import Contestant
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.certificate import Certificate, Demands
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty

KNOWN_BIAS = (-2e-4, 2e-4)  # V


def decisions(quick: bool) -> tuple[Contestant, ...]:
    """Narrow gaps with a known input bias, and the whole stated range; `quick`: fewer and shorter runs."""
    return (
        _decision("gap of 10 deg", (9.9, 10.1), KNOWN_BIAS, quick),
        _decision("gap of 40 deg", (39.9, 40.1), KNOWN_BIAS, quick),
        _decision("fallback set", (0.0, 60.0), (-0.1, 0.1), quick),
    )


def _decision(name: str, gap_deg: tuple[float, float], bias: tuple[float, float], quick: bool) -> Contestant:
    servo, demands = Servo.preset("paper"), Demands()
    if quick:
        demands = replace(demands, machines=16, conditions=4, screened=2, settled=0.8)
    known = Uncertainty(gap=(math.radians(gap_deg[0]), math.radians(gap_deg[1])), input_bias=bias)
    trial = trial_for(servo, known, demands)

    def job() -> Array:
        result = certify(servo, known, demands, trial)
        settled = result.settled if isinstance(result, Certificate) else 0.0
        return np.array([settled, result.members if isinstance(result, Certificate) else 0.0])

    return Contestant(name, lambda: job)
