"""Accuracy, calibration and speed of the default and the joint estimator: the figures of the docs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median

import numpy as np

from benchmarks import estimator_conditions as conditions
from benchmarks import estimator_joint as joint
from benchmarks.cramer_rao import bound, noise_root
from benchmarks.estimator_figures import (
    ANY,
    FLOOR,
    OPEN_MINDED,
    Answers,
    Figure,
    answers,
    clean_cases,
    eight_gaps,
    on_floor,
)
from benchmarks.estimator_windows import RATE, WindowCase, paper_loop_cases, random_cases
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.machine import LearningSettings, nameplate
from servotwin.estimation.paper.estimator import PaperSettings
from servotwin.estimation.whitened.estimator import fit
from servotwin.estimation.whitened.fit import plain_fit
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.noise import Noise
from servotwin.plant.signals import Array

PAPER_NOISE = Noise(0.22e-3)
_TARGETS = {"plain fit": 0.3, "gated and whitened": 10.0}  # ms
Clock = Callable[[], float]


def table(size: float = 1.0, seed: int = 2026) -> Iterator[Figure]:
    """All figures, one experiment after the other.

    Parameters
    ----------
    size : float
        1: as many windows as docs/estimator.md states; 0.1: a tenth, and so on.
    seed : int
    """

    def share(count: int) -> int:
        return max(1, round(size * count))

    yield from noise_free(share(500), seed)
    yield from in_the_papers_noise(share(26), seed)
    yield from in_the_papers_noise(share(6), seed, 1e-7)
    yield from in_the_papers_noise(share(6), seed, 1e-5)
    yield from in_white_noise(share(26), seed)
    yield from conditions.in_coloured_noise(share(40), seed, 0.9)
    yield from conditions.in_coloured_noise(share(40), seed, 0.99, False)
    yield from conditions.quantised(share(40), seed)
    yield from conditions.coarse_encoder(share(6), seed)
    yield from conditions.skewed(share(9), seed)
    yield from conditions.wrong_model(share(9), seed)
    yield from conditions.compliant_screw(seed)
    yield from random_windows(share(1000), seed)
    yield from joint.table(share(8), seed)
    yield from speed(share(24), seed)


def noise_free(count: int, seed: int) -> list[Figure]:
    """Two-contact windows at random, gaps up to 60 deg."""
    results = answers(random_cases(np.random.default_rng(seed), count, math.radians(60.0), True, constant=True))
    wrong = np.nanmax(np.abs(results.errors))
    refused = int(np.count_nonzero(np.logical_not(results.accepted)))
    right = float(np.mean(np.abs(np.nan_to_num(results.errors, nan=1.0)) <= 1e-3))
    return [
        Figure("noise-free: within 1e-3 deg, share", right, (1.0, 1.0), count, f"{refused} refused"),
        Figure("noise-free: largest error of an accepted window, deg", float(wrong), (0.0, 1e-3), count),
    ]


def in_the_papers_noise(per_gap: int, seed: int, floor: float = FLOOR) -> list[Figure]:
    """The paper's loop, 0.22 mm high-passed and a white floor; beside the paper's estimator and the bound."""
    cases = paper_noise_cases(per_gap, seed, floor)
    results = answers(cases, settings=OPEN_MINDED)
    errors, label = results.errors[results.accepted], f"paper noise, floor {1e6 * floor:g} um"
    limits = _bounds(cases, floor, PAPER_NOISE)
    judged = floor == FLOOR
    figures = [
        Figure(f"{label}: bias, deg", float(errors.mean()), (-0.005, 0.005) if judged else ANY, errors.size),
        Figure(f"{label}: std, deg", float(errors.std()), (0.0, 0.01) if judged else ANY, errors.size),
        Figure(f"{label}: std over Cramer-Rao bound", _ratio(results, limits), ANY, errors.size),
        Figure(f"{label}: Cramer-Rao bound, deg", float(np.sqrt(np.mean(limits**2))), ANY, errors.size),
        Figure(f"{label}: coverage of std", results.coverage(), ANY, errors.size),
    ]
    return [*figures, against_the_paper(cases, errors)] if judged else figures


def paper_noise_cases(per_gap: int, seed: int, floor: float) -> list[WindowCase]:
    """The paper's loop in its noise, and a white floor (m) on top."""
    rng = np.random.default_rng(seed)
    return [on_floor(case, floor, rng) for case in paper_loop_cases(eight_gaps(), per_gap, seed, PAPER_NOISE)]


def against_the_paper(cases: Sequence[WindowCase], errors: Array) -> Figure:
    """Root mean square error of the paper's method over ours."""
    settings = PaperSettings(lowpass_hz=20.0)
    published = [estimate_gap(c.window, c.servo, method="paper", prior=c.gap, settings=settings) for c in cases]
    others = np.array([math.degrees(e.gap - c.gap) for c, e in zip(cases, published, strict=True) if e.ok])
    ratio = float(np.sqrt(np.mean(others**2)) / np.sqrt(np.mean(errors**2)))
    remark = f"paper's: bias {others.mean():+.3f}, std {others.std():.3f} deg"
    return Figure("paper noise: rms error of method 'paper' over ours", ratio, (20.0, math.inf), others.size, remark)


def in_white_noise(per_gap: int, seed: int) -> list[Figure]:
    """The paper's loop without noise in it, 1 um of white noise on the position."""
    rng = np.random.default_rng(seed)
    cases = [on_floor(c, FLOOR, rng) for c in paper_loop_cases(eight_gaps(), per_gap, seed, None)]
    results = answers(cases)
    ratio, size = _ratio(results, _bounds(cases, FLOOR, None)), int(results.accepted.sum())
    return [
        Figure("white noise: std over Cramer-Rao bound", ratio, (0.8, 1.1), size),
        Figure("white noise: coverage of std", results.coverage(), (0.92, 0.98), size),
    ]


def random_windows(count: int, seed: int) -> list[Figure]:
    """Any window of any loop, 1 um of white noise on every second one: quiet, one contact, straddling, cycling."""
    rng = np.random.default_rng(seed)
    drawn = random_cases(rng, count, math.radians(25.0), False)
    cases = [on_floor(case, FLOOR, rng) if number % 2 else case for number, case in enumerate(drawn)]
    results = answers(cases)
    errors = np.abs(np.nan_to_num(results.errors, nan=0.0))
    both = np.array([case.two_contacts for case in cases])
    worst = cases[int(np.argmax(errors))].words
    statuses = {status.value: sum(e.status is status for e in results.estimates) for status in GapStatus}
    return [
        Figure(
            "random windows: accepted and off by more than 0.1 deg",
            float(np.sum(errors > 0.1)),
            (0.0, 0.0),
            count,
            str(statuses),
        ),
        Figure("random windows: largest error accepted, deg", float(errors.max()), (0.0, 0.1), count, worst),
        Figure(
            "random windows: share of two-contact windows accepted",
            float(results.accepted[both].mean()),
            (0.9, 1.0),
            int(both.sum()),
        ),
        _bounds_kept(results),
    ]


def _bounds_kept(results: Answers) -> Figure:
    """Share of lower bounds above the gap: one-sided at 95 %, a fortieth may be."""
    pairs = zip(results.cases, results.estimates, strict=True)
    excess = [math.degrees(e.gap - c.gap) for c, e in pairs if e.status is GapStatus.LOWER_BOUND]
    above = [x for x in excess if x > 0.0]
    share, remark = len(above) / max(1, len(excess)), f"by up to {max(above, default=0.0):.2g} deg"
    return Figure("random windows: lower bounds above the gap, share", share, (0.0, 0.025), len(excess), remark)


def speed(count: int, seed: int, clock: Clock = time.process_time) -> list[Figure]:
    """Milliseconds of processor time a window (median) and their ratio to one fit from a start 2 deg off.

    Gated and whitened, as the first window of a machine that is not known, and on a machine that has been learnt.
    """
    rng = np.random.default_rng(seed)
    cases = [on_floor(c, FLOOR, rng) for c in clean_cases(max(1, count // 8), seed)]
    jobs: dict[str, Callable[[WindowCase], object]] = {
        "plain fit": lambda c: plain_fit(c.window, c.servo, max(0.0, c.gap - 0.035)),
        "gated and whitened": lambda c: estimate_gap(c.window, c.servo),
        "first window of an unknown machine": partial(_learning, nameplate(LearningSettings(), 0.15, 0.5, 0.1)),
        "window of a learnt machine": partial(_learning, FactorPrior.of_spreads(1e-3, 1e-2, 5e-4, 1e-2)),
    }
    for job in jobs.values():
        job(cases[0])
    times = np.array([_times([partial(job, case) for job in jobs.values()], clock) for case in cases]).T
    ratios = times / times[0]
    return [
        Figure(
            f"{name}, ms (median)",
            median(each),
            (0.0, _TARGETS.get(name, 50.0)),
            len(cases),
            f"fastest {min(each):.2f} ms; {median(ratio):.3g} times the plain fit",
        )
        for name, each, ratio in zip(jobs, times.tolist(), ratios.tolist(), strict=True)
    ]


def _learning(known: FactorPrior, case: WindowCase) -> object:
    return fit(case.window, case.servo, None, None, known).concluded()


def _times(jobs: Sequence[Callable[[], object]], clock: Clock) -> list[float]:
    """Times of jobs that take turns, ms: the shortest of three runs of each."""
    times = [math.inf] * len(jobs)
    for place in [*range(len(jobs))] * 3:
        begin = clock()
        jobs[place]()
        times[place] = min(times[place], 1e3 * (clock() - begin))
    return times


def _bounds(cases: Sequence[WindowCase], floor: float, noise: Noise | None) -> Array:
    """(n,) deg, Cramer-Rao bounds."""
    root = noise_root(cases[0].window.position.size, RATE, floor, noise)
    angles = [case.window.theta_m for case in cases]
    pairs = [(c, angle) for c, angle in zip(cases, angles, strict=True) if angle is not None]
    return np.degrees([bound(c.servo, angle, RATE, c.gap, c.theta_d0, root) for c, angle in pairs])


def _ratio(results: Answers, limits: Array) -> float:
    """Root mean square of error over bound."""
    return float(np.sqrt(np.mean((results.errors / limits)[results.accepted] ** 2)))
