"""How right the default estimator is, how well it knows that, and how fast it is: every figure of docs/estimator.md."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from scipy.signal import lfilter

from servotwin.bench.cramer_rao import bound, noise_root
from servotwin.bench.estimator_windows import RATE, Case, paper_loop_cases, random_cases
from servotwin.identify.estimate import GapEstimate, GapStatus
from servotwin.identify.gap import estimate_gap
from servotwin.identify.paper import Settings as PaperSettings
from servotwin.identify.whitened import Settings
from servotwin.identify.window import Window
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

PAPER_NOISE = Noise(0.22e-3)
FLOOR = 1e-6  # m
_NORMAL_95 = 1.959963984540054
Clock = Callable[[], float]


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes
    ----------
    name : str
        What was measured, with its unit.
    value : float
    target : (float, float)
        Between what it must lie; (-inf, inf) where it is only reported.
    windows : int
    remark : str
    """

    name: str
    value: float
    target: tuple[float, float]
    windows: int
    remark: str = ""

    @property
    def met(self) -> bool:
        """Whether the value is what it must be."""
        return self.target[0] <= self.value <= self.target[1]


@dataclass(frozen=True, eq=False)
class Answers:
    """Estimates of some cases, accepted or not."""

    cases: Sequence[Case]
    estimates: Sequence[GapEstimate]

    @property
    def accepted(self) -> Array:
        """(n,) of bool."""
        return np.array([estimate.ok for estimate in self.estimates])

    @property
    def errors(self) -> Array:
        """(n,) deg; NaN where refused."""
        pairs = zip(self.cases, self.estimates, strict=True)
        return np.array([math.degrees(e.gap - c.gap) if e.ok else math.nan for c, e in pairs])

    def coverage(self, spread: str = "std") -> float:
        """Share of the accepted errors within 1.96 `spread`."""
        stds = np.degrees([getattr(estimate, spread) for estimate in self.estimates])
        ratio = np.abs(self.errors)[self.accepted] / stds[self.accepted]
        return float(np.mean(ratio <= _NORMAL_95)) if ratio.size else math.nan


def answers(cases: Iterable[Case], servo: Servo | None = None, settings: Settings | None = None) -> Answers:
    """The default estimator's, with another model where one is given."""
    known = list(cases)
    return Answers(known, [estimate_gap(c.window, servo or c.servo, settings=settings) for c in known])


def noise_free(count: int, seed: int) -> list[Figure]:
    """Two-contact windows at random, gaps up to 60 deg."""
    found = answers(random_cases(np.random.default_rng(seed), count, math.radians(60.0), True, constant=True))
    wrong = np.nanmax(np.abs(found.errors))
    refused = int(np.sum(~found.accepted))
    right = float(np.mean(np.abs(np.nan_to_num(found.errors, nan=1.0)) <= 1e-3))
    return [
        Figure("noise-free: within 1e-3 deg, share", right, (1.0, 1.0), count, f"{refused} refused"),
        Figure("noise-free: largest error of an accepted window, deg", float(wrong), (0.0, 1e-3), count),
    ]


def in_the_papers_noise(per_gap: int, seed: int, floor: float = FLOOR) -> list[Figure]:
    """The paper's loop, 0.22 mm high-passed and a white floor; beside the paper's estimator and the bound."""
    rng = np.random.default_rng(seed)
    gaps = np.radians(np.linspace(4.0, 18.0, 8))
    cases = [_on_floor(case, floor, rng) for case in paper_loop_cases(gaps, per_gap, seed, PAPER_NOISE)]
    found = answers(cases, settings=Settings(largest_std=math.radians(2.0), largest_shift=math.radians(2.0)))
    errors, label = found.errors[found.accepted], f"paper noise, floor {1e6 * floor:g} um"
    limits = _bounds(cases, floor, PAPER_NOISE)
    judged = floor == FLOOR
    figures = [
        Figure(f"{label}: bias, deg", float(errors.mean()), (-0.005, 0.005) if judged else ANY, errors.size),
        Figure(f"{label}: std, deg", float(errors.std()), (0.0, 0.01) if judged else ANY, errors.size),
        Figure(f"{label}: std over Cramer-Rao bound", _ratio(found, limits), ANY, errors.size),
        Figure(f"{label}: Cramer-Rao bound, deg", float(np.sqrt(np.mean(limits**2))), ANY, errors.size),
        Figure(f"{label}: coverage of std", found.coverage(), ANY, errors.size),
    ]
    return [*figures, _against_the_paper(cases, errors)] if judged else figures


ANY = (-math.inf, math.inf)


def _against_the_paper(cases: Sequence[Case], errors: Array) -> Figure:
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
    cases = [_on_floor(c, FLOOR, rng) for c in paper_loop_cases(_gaps(), per_gap, seed, None)]
    found = answers(cases)
    ratio, size = _ratio(found, _bounds(cases, FLOOR, None)), int(found.accepted.sum())
    return [
        Figure("white noise: std over Cramer-Rao bound", ratio, (0.8, 1.1), size),
        Figure("white noise: coverage of std", found.coverage(), (0.92, 0.98), size),
    ]


def in_coloured_noise(per_gap: int, seed: int, memory: float, judged: bool = True) -> list[Figure]:
    """First-order autoregressive noise of 1 um, its memory that from one sample to the next."""
    rng = np.random.default_rng(seed)
    cases = [c.noisy(_autoregressive(c.window.position.size, memory, rng)) for c in _clean(per_gap, seed)]
    found = answers(cases)
    size, target = int(found.accepted.sum()), (0.92, 0.98) if judged else ANY
    return [Figure(f"AR(1) noise, {memory:g}: coverage of std", found.coverage(), target, size)]


def quantised(per_gap: int, seed: int, step: float = 5e-6) -> list[Figure]:
    """The position in steps (m), a little noise below one step."""
    rng = np.random.default_rng(seed)
    cases = []
    for case in _clean(per_gap, seed):
        seen = case.window.position + 0.3 * step * rng.standard_normal(case.window.position.size)
        cases.append(case.noisy(np.round(seen / step) * step - case.window.position))
    found = answers(cases)
    name = f"position in steps of {1e6 * step:g} um: coverage of std"
    return [Figure(name, found.coverage(), (0.92, 0.98), int(found.accepted.sum()))]


def coarse_encoder(per_gap: int, seed: int, counts: int = 8192) -> list[Figure]:
    """An encoder of so many counts per turn, white noise of 1 um on the position."""
    rng = np.random.default_rng(seed)
    resolution = 2.0 * math.pi / counts
    cases = []
    for case in _clean(per_gap, seed):
        angle = np.round(case.window.theta_m / resolution) * resolution
        seen = _on_floor(case, FLOOR, rng)
        cases.append(
            seen.replaced(seen.window.replace(theta_m=angle), case.servo.replace(encoder_resolution=resolution))
        )
    found = answers(cases)
    errors = found.errors[found.accepted]
    name = f"encoder of {counts} counts"
    return [
        Figure(f"{name}: rms error, deg", float(np.sqrt(np.mean(errors**2))), ANY, errors.size),
        Figure(f"{name}: coverage of std", found.coverage(), ANY, errors.size),
        Figure(f"{name}: coverage of std_total", found.coverage("std_total"), (0.95, 1.0), errors.size),
    ]


def wrong_model(per_gap: int, seed: int) -> list[Figure]:
    """k off by 1 %, c by 20 %, and both: what is accepted, and whether std_total covers it if nothing is refused."""
    rng = np.random.default_rng(seed)
    cases = [_on_floor(c, FLOOR, rng) for c in _clean(per_gap, seed)]
    open_minded = Settings(largest_std=10.0, largest_shift=10.0)
    figures = []
    for words, k, c in (("k +1 %", 1.01, 1.0), ("c +20 %", 1.0, 1.2), ("k -1 %, c -20 %", 0.99, 0.8)):
        model = Servo.preset("paper").replace(k=k * 1e4, c=c * 36.9)
        strict, mild = answers(cases, model), answers(cases, model, open_minded)
        errors = np.abs(mild.errors[mild.accepted])
        share = float(np.mean(strict.accepted & (np.abs(np.nan_to_num(strict.errors, nan=0.0)) > 0.1)))
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
    for number, case in enumerate(_clean(per_gap, seed)):
        shift, window = samples[number % len(samples)], _on_floor(case, FLOOR, rng).window
        assert window.theta_m is not None
        late, early = max(shift, 0), max(-shift, 0)
        size = window.position.size - abs(shift)
        moved = Window(window.position[early : early + size], window.theta_m[late : late + size], sample_rate=RATE)
        cases.append(case.replaced(moved, case.servo))
    found = answers(cases)
    errors = np.abs(np.nan_to_num(found.errors, nan=1.0))
    refused = int(np.sum(~found.accepted))
    return [
        Figure(
            "skew up to 1 ms: largest error, deg", float(errors.max()), (0.0, 0.02), errors.size, f"{refused} refused"
        )
    ]


def compliant_screw(seed: int, stiffnesses: Sequence[float] = (1e7, 3e6, 1e6, 3e5, 1e5)) -> list[Figure]:
    """A plant with an elastic screw, a model with a rigid one: the bias if nothing were refused, and what is said."""
    figures = []
    rng = np.random.default_rng(seed)
    for k_d in stiffnesses:
        plant = Servo.preset("paper").replace(k_d=k_d)
        rigid = plant.replace(k_d=math.inf)
        cases = [_on_floor(c, FLOOR, rng) for c in paper_loop_cases(_gaps(), 3, seed, None, servo=plant)]
        strict, mild = answers(cases, rigid), answers(cases, rigid, Settings(largest_std=10.0, largest_shift=10.0))
        flagged = np.array([e.status is GapStatus.MODEL_MISMATCH for e in strict.estimates])
        errors = mild.errors
        large = np.abs(np.nan_to_num(errors, nan=1.0)) > 0.1
        missed = int(np.sum(large & ~flagged))
        remark = f"bias {np.nanmean(errors):+.3f}, up to {np.nanmax(np.abs(errors)):.3f} deg; {flagged.sum()} flagged"
        name = f"screw of {k_d:g} N/m taken as rigid: off by more than 0.1 deg, not flagged"
        figures.append(Figure(name, float(missed), (0.0, 0.0), len(cases), remark))
    return figures


def random_windows(count: int, seed: int) -> list[Figure]:
    """Any window of any loop, 1 um of white noise on every second one: quiet, one contact, straddling, limit-cycling."""
    rng = np.random.default_rng(seed)
    drawn = random_cases(rng, count, math.radians(25.0), False)
    cases = [_on_floor(case, FLOOR, rng) if number % 2 else case for number, case in enumerate(drawn)]
    found = answers(cases)
    errors = np.abs(np.nan_to_num(found.errors, nan=0.0))
    both = np.array([case.two_contacts for case in cases])
    worst = cases[int(np.argmax(errors))].words
    statuses = {status.value: sum(e.status is status for e in found.estimates) for status in GapStatus}
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
            float(found.accepted[both].mean()),
            (0.9, 1.0),
            int(both.sum()),
        ),
    ]


def speed(count: int, seed: int, clock: Clock = time.perf_counter) -> list[Figure]:
    """Milliseconds a window, median and smallest: gated and whitened; one fit from a start 2 deg off."""
    from servotwin.identify.plain import plain_fit

    rng = np.random.default_rng(seed)
    cases = [_on_floor(c, FLOOR, rng) for c in _clean(max(1, count // 8), seed)]
    answers(cases[:2])
    whole = _times([lambda c=c: estimate_gap(c.window, c.servo) for c in cases], clock)  # type: ignore[misc]
    fits = _times([lambda c=c: plain_fit(c.window, c.servo, max(0.0, c.gap - 0.035)) for c in cases], clock)  # type: ignore[misc]
    return [
        Figure(
            "gated and whitened, ms (median)", median(whole), (0.0, 20.0), len(cases), f"fastest {min(whole):.2f} ms"
        ),
        Figure("plain fit, ms (median)", median(fits), (0.0, 1.0), len(cases), f"fastest {min(fits):.2f} ms"),
    ]


def _times(jobs: Sequence[Callable[[], object]], clock: Clock) -> list[float]:
    """ms: the shorter of two runs of each."""
    found = []
    for job in jobs:
        runs = []
        for _ in range(2):
            begin = clock()
            job()
            runs.append(1e3 * (clock() - begin))
        found.append(min(runs))
    return found


def _gaps() -> Array:
    return np.radians(np.linspace(4.0, 18.0, 8))


def _clean(per_gap: int, seed: int) -> list[Case]:
    return paper_loop_cases(_gaps(), per_gap, seed, None)


def _on_floor(case: Case, floor: float, rng: np.random.Generator) -> Case:
    return case.noisy(floor * rng.standard_normal(case.window.position.size))


def _autoregressive(size: int, memory: float, rng: np.random.Generator) -> Array:
    """(n,) m, of 1 um rms, stationary."""
    drive = FLOOR * math.sqrt(1.0 - memory**2) * rng.standard_normal(size + 5000)
    return np.asarray(lfilter([1.0], [1.0, -memory], drive)[5000:])


def _bounds(cases: Sequence[Case], floor: float, noise: Noise | None) -> Array:
    """(n,) deg, Cramer-Rao bounds."""
    root = noise_root(cases[0].window.position.size, RATE, floor, noise)
    angles = [case.window.theta_m for case in cases]
    pairs = [(c, angle) for c, angle in zip(cases, angles, strict=True) if angle is not None]
    return np.degrees([bound(c.servo, angle, RATE, c.gap, c.theta_d0, root) for c, angle in pairs])


def _ratio(found: Answers, limits: Array) -> float:
    """Root mean square of error over bound."""
    return float(np.sqrt(np.mean((found.errors / limits)[found.accepted] ** 2)))
