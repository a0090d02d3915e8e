"""The estimator where the world is not as assumed: coloured noise, coarse sensors, a wrong model, channels apart."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from benchmarks.estimator_figures import (
    ANY,
    FLOOR,
    OPEN_MINDED,
    Figure,
    answers,
    clean_cases,
    eight_gaps,
    on_floor,
)
from benchmarks.estimator_windows import RATE, paper_loop_cases
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array


def in_coloured_noise(per_gap: int, seed: int, memory: float, judged: bool = True) -> list[Figure]:
    """First-order autoregressive noise of 1 um, its memory that from one sample to the next."""
    rng = np.random.default_rng(seed)
    cases = [c.noisy(_autoregressive(c.window.position.size, memory, rng)) for c in clean_cases(per_gap, seed)]
    results = answers(cases)
    size, target = int(results.accepted.sum()), (0.92, 0.98) if judged else ANY
    return [Figure(f"AR(1) noise, {memory:g}: coverage of std", results.coverage(), target, size)]


def quantised(per_gap: int, seed: int, step: float = 5e-6) -> list[Figure]:
    """The position in steps (m), a little noise below one step."""
    rng = np.random.default_rng(seed)
    cases = []
    for case in clean_cases(per_gap, seed):
        windows = case.window.position + 0.3 * step * rng.standard_normal(case.window.position.size)
        cases.append(case.noisy(np.round(windows / step) * step - case.window.position))
    results = answers(cases)
    name = f"position in steps of {1e6 * step:g} um: coverage of std"
    return [Figure(name, results.coverage(), (0.92, 0.98), int(results.accepted.sum()))]


def coarse_encoder(per_gap: int, seed: int, counts: int = 8192) -> list[Figure]:
    """An encoder of so many counts per turn, white noise of 1 um on the position."""
    rng = np.random.default_rng(seed)
    resolution = 2.0 * math.pi / counts
    cases = []
    for case in clean_cases(per_gap, seed):
        assert case.window.theta_m is not None
        angle = np.round(case.window.theta_m / resolution) * resolution
        windows = on_floor(case, FLOOR, rng)
        cases.append(
            windows.replaced(windows.window.replace(theta_m=angle), case.servo.replace(encoder_resolution=resolution))
        )
    results = answers(cases)
    errors = results.errors[results.accepted]
    name = f"encoder of {counts} counts"
    return [
        Figure(f"{name}: rms error, deg", float(np.sqrt(np.mean(errors**2))), ANY, errors.size),
        Figure(f"{name}: coverage of std", results.coverage(), ANY, errors.size),
        Figure(f"{name}: coverage of std_total", results.coverage("std_total"), (0.95, 1.0), errors.size),
    ]


def wrong_model(per_gap: int, seed: int) -> list[Figure]:
    """k off by 1 %, c by 20 %, and both: accepted windows, and coverage of std_total if nothing is refused."""
    rng = np.random.default_rng(seed)
    cases = [on_floor(c, FLOOR, rng) for c in clean_cases(per_gap, seed)]
    figures = []
    for words, k, c in (("k +1 %", 1.01, 1.0), ("c +20 %", 1.0, 1.2), ("k -1 %, c -20 %", 0.99, 0.8)):
        model = Servo.preset("paper").replace(k=k * 1e4, c=c * 36.9)
        strict, mild = answers(cases, model), answers(cases, model, OPEN_MINDED)
        errors = np.abs(mild.errors[mild.accepted])
        share = float(np.mean(np.abs(np.nan_to_num(strict.errors, nan=0.0)) > 0.1))
        remark = f"errors up to {errors.max():.2f} deg, {int(strict.accepted.sum())} of {len(cases)} accepted"
        figures += [
            Figure(
                f"{words}: coverage of std_total, nothing refused", mild.coverage("std_total"), (0.95, 1.0), errors.size
            ),
            Figure(f"{words}: accepted and off by more than 0.1 deg, share", share, (0.0, 0.0), len(cases), remark),
        ]
    return figures


def skewed(per_gap: int, seed: int, samples: Sequence[int] = (-5, -2, -1, 1, 3, 5)) -> list[Figure]:
    """Position and motor angle apart by up to 1 ms; 1 um of white noise."""
    rng = np.random.default_rng(seed)
    cases = []
    for number, case in enumerate(clean_cases(per_gap, seed)):
        shift, window = samples[number % len(samples)], on_floor(case, FLOOR, rng).window
        assert window.theta_m is not None
        late, early = max(shift, 0), max(-shift, 0)
        size = window.position.size - abs(shift)
        moved = Window(window.position[early : early + size], window.theta_m[late : late + size], sample_rate=RATE)
        cases.append(case.replaced(moved, case.servo))
    results = answers(cases)
    errors = np.abs(np.nan_to_num(results.errors, nan=1.0))
    refused = int(np.count_nonzero(np.logical_not(results.accepted)))
    return [
        Figure(
            "skew up to 1 ms: largest error, deg", float(errors.max()), (0.0, 0.02), errors.size, f"{refused} refused"
        )
    ]


def compliant_screw(seed: int, stiffnesses: Sequence[float] = (1e7, 3e6, 1e6, 3e5, 1e5)) -> list[Figure]:
    """A plant with an elastic screw, a model with a rigid one: the bias if nothing were refused, and the statuses."""
    figures = []
    rng = np.random.default_rng(seed)
    for k_d in stiffnesses:
        plant = Servo.preset("paper").replace(k_d=k_d)
        rigid = plant.replace(k_d=math.inf)
        cases = [on_floor(c, FLOOR, rng) for c in paper_loop_cases(eight_gaps(), 3, seed, None, servo=plant)]
        strict, mild = answers(cases, rigid), answers(cases, rigid, OPEN_MINDED)
        flagged = np.array([e.status is GapStatus.MODEL_MISMATCH for e in strict.estimates])
        errors = mild.errors
        large = np.abs(np.nan_to_num(errors, nan=1.0)) > 0.1
        missed = int(np.sum(large & np.logical_not(flagged)))
        known = errors[mild.accepted]
        off = f"bias {known.mean():+.3f}, up to {np.abs(known).max():.3f} deg" if known.size else "nothing explained"
        remark = f"{off}; {flagged.sum()} flagged"
        name = f"screw of {k_d:g} N/m taken as rigid: off by more than 0.1 deg, not flagged"
        figures.append(Figure(name, float(missed), (0.0, 0.0), len(cases), remark))
    return figures


def _autoregressive(size: int, memory: float, rng: np.random.Generator) -> Array:
    """(n,) m, of 1 um rms, stationary."""
    drive = FLOOR * math.sqrt(1.0 - memory**2) * rng.standard_normal(size + 5000)
    return np.asarray(lfilter([1.0], [1.0, -memory], drive)[5000:])
