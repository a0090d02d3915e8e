"""W3: the gap from windows of 1 s, by the paper's method as we have it and as one writes it with scipy, and by ours."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np

from benchmarks.contest import Contestant, Job
from benchmarks.ours import NAME, run_wear
from benchmarks.workloads import WearWorkload
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.paper.observer import Observer, observer
from servotwin.estimation.window import Window
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import compiled
from servotwin.plant.backlash import play_samples

LENGTH = 1.0  # s, of a window
ALPHA, SETTLE = 40.0, 0.25  # rad/s and s, section 4.1
MILLIMETRE = 1e3  # the cost is in mm^2: in m^2 it lies below BFGS's tolerance from the start
WRONG = math.radians(1.0)
Predictor: TypeAlias = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class FitWindow:
    """A window, the gap known before it and the gap in its middle, rad."""

    window: Window
    prior: float
    truth: float


@cache
def cases(workload: WearWorkload) -> tuple[FitWindow, ...]:
    """The first second after each reference step of W1's run."""
    run, gap = run_wear(workload), workload.gap.pieces(workload.duration)
    starts = [0.5 * workload.period * turn for turn in range(workload.turns)]
    windows = [Window.from_run(run, start, LENGTH) for start in starts]
    truths = [float(gap.value(window.mid_time)) for window in windows]
    return tuple(FitWindow(*case) for case in zip(windows, [0.0, *truths], truths, strict=False))


def ours(workload: WearWorkload, method: str = "paper") -> Contestant:
    """A method of the package; NaN where it refuses to answer."""

    def prepare() -> Job:
        given, servo = cases(workload), workload.servo

        def gap(case: FitWindow) -> float:
            results = estimate_gap(case.window, servo, method=method, prior=case.prior)
            return results.gap if results.ok else math.nan

        return lambda: np.array([gap(case) for case in given])

    return Contestant(NAME if method == "paper" else f"{NAME}, {method}", prepare)


def scipy_fits(workload: WearWorkload, name: str, predictor: Callable[[Observer, FitWindow], Predictor]) -> Contestant:
    """BFGS by scipy.optimize with its own differences; `predictor` says how the observer is run."""

    def prepare() -> Job:
        given, model = cases(workload), observer(workload.servo, ALPHA)
        predictors = [predictor(model, case) for case in given]
        return lambda: np.array([_fitted(*pair) for pair in zip(given, predictors, strict=True)])

    return Contestant(name, prepare)


def _fitted(case: FitWindow, predict: Predictor) -> float:
    from scipy.optimize import minimize

    theta_m, position = _channels(case)
    skip = round(SETTLE * case.window.sample_rate)

    def cost(point: Array) -> float:
        screw = play_samples(theta_m, np.array([0.5 * abs(point[0])]), point[1])
        miss = MILLIMETRE * (position - predict(screw))[skip:]
        return float(miss @ miss)

    direction = float(np.sign(theta_m[1] - theta_m[0]))
    start = np.array([case.prior, theta_m[0] - 0.5 * case.prior * direction])
    return abs(float(minimize(cost, start, method="BFGS").x[0]))


def with_lfilter(model: Observer, case: FitWindow) -> Predictor:
    """The observer as two transfer functions (scipy.signal); the position's part is filtered once."""
    from scipy import signal

    A, B, C, D = _sampled(model, case.window.sample_rate)
    by_screw, denominator = signal.ss2tf(A, B, C, D, input=0)
    by_position, _ = signal.ss2tf(A, B, C, D, input=1)
    fixed = signal.lfilter(by_position[0], denominator, _channels(case)[1])
    return lambda screw: np.asarray(signal.lfilter(by_screw[0], denominator, screw) + fixed)


def with_loop(model: Observer, case: FitWindow) -> Predictor:
    """The observer as a compiled loop over its states."""
    A, B, _, D = _sampled(model, case.window.sample_rate)
    position = _channels(case)[1]
    return lambda screw: observed(A, B, D[0], screw, position)


def _sampled(model: Observer, rate: float) -> tuple[Array, Array, Array, Array]:
    """The observer with inputs (screw, position), exact where they are linear between samples."""
    from scipy import signal

    inputs = np.column_stack([model.B, model.L])
    system = (model.A, inputs, model.C[None, :], np.zeros((1, 2)))
    return signal.cont2discrete(system, 1.0 / rate, method="foh")[:4]


@compiled
def observed(A: Array, B: Array, D: Array, screw: Array, position: Array) -> Array:
    """The observer's output at every sample, from rest."""
    state, following = np.zeros(len(A)), np.zeros(len(A))
    out = np.empty_like(screw)
    for k in range(screw.size):
        out[k] = state[0] + D[0] * screw[k] + D[1] * position[k]
        for i in range(len(A)):
            total = B[i, 0] * screw[k] + B[i, 1] * position[k]
            for j in range(len(A)):
                total += A[i, j] * state[j]
            following[i] = total
        state[:] = following
    return out


def _channels(case: FitWindow) -> tuple[Array, Array]:
    assert case.window.theta_m is not None
    return case.window.theta_m, case.window.position


def typical_error(workload: WearWorkload, gaps: Array) -> float:
    """Median error (deg) of the answers that are not plainly wrong; NaN when there is none."""
    errors = _errors(workload, gaps)
    sound = errors[errors <= WRONG]
    return math.degrees(float(np.median(sound))) if sound.size else math.nan


def wrong_answers(workload: WearWorkload, gaps: Array) -> float:
    """Number of answers off by more than 1 deg; a refusal is not a wrong answer."""
    return float(np.count_nonzero(_errors(workload, gaps) > WRONG))


def _errors(workload: WearWorkload, gaps: Array) -> Array:
    return np.abs(gaps - np.array([case.truth for case in cases(workload)]))
