"""Noise-free windows with a known, constant gap, and what the published estimator makes of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import servotwin as st
from servotwin.estimation.paper.estimator import Settings
from servotwin.reproduction.runs import BIPOLAR, PERIOD, RATE

GAPS_DEG = (3.0, 10.0, 18.0)
STEPS = 6


@dataclass(frozen=True, slots=True)
class WindowJob:
    """The estimator's mean error (deg) by gap, from 1 s windows after each of six steps; `settle` s are left out."""

    preset: str
    settle: float

    def run(self) -> Mapping[float, float]:
        """Mean error for each gap."""
        servo = st.Servo.preset(self.preset)
        return {gap: float(np.mean(_errors(servo, gap, self.settle))) for gap in GAPS_DEG}


def _errors(servo: st.Servo, gap_deg: float, settle: float) -> list[float]:
    """Error of each window's estimate, deg; every search starts from the truth's two thirds."""
    gap = math.radians(gap_deg)
    run = st.simulate(
        servo,
        STEPS * PERIOD / 2.0,
        reference=BIPOLAR.signal,
        gap=gap,
        tolerance=servo.tolerance_for(gap),
        sample_rate=RATE,
    )
    starts = np.arange(STEPS) * PERIOD / 2.0
    windows = [st.Window.from_run(run, float(start), 1.0) for start in starts]
    settings = Settings(settle_s=settle)
    found = [
        st.estimate_gap(window, servo, method="paper", prior=gap * 2.0 / 3.0, settings=settings) for window in windows
    ]
    return [math.degrees(one.gap - gap) for one in found if one.ok]
