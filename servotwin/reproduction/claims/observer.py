"""Claims about the observer of the Appendix."""

from __future__ import annotations

from math import comb

import numpy as np

from servotwin.estimation.paper.observer import Observer, observer
from servotwin.reproduction import measures as measure
from servotwin.reproduction.claims.registry import Finding, decided, measures
from servotwin.reproduction.figures.observer import ALPHAS, INITIAL
from servotwin.reproduction.measures import Array, Complex
from servotwin.reproduction.runs import Runs

ALPHA = 40.0  # rad/s, Appendix
BAND = 0.02 * 1.5e-3  # m: 2 % of the initial error


@measures("observer-quarter-second")
def quarter_second(runs: Runs) -> Finding:
    """Time after which the error stays below 2 % of its start, from the matrix exponential."""
    times = {alpha: _forgetting_time(observer(runs.servo, alpha)) for alpha in ALPHAS}
    why = f"with α = 40 the error stays below 2 % of the initial 1.5 mm after {times[ALPHA]:.3g} s"
    values = [(f"time for α = {alpha:g} 1/s", time, "s") for alpha, time in times.items()]
    return decided(times[ALPHA] <= 0.25, why, *values)


def _forgetting_time(one: Observer) -> float:
    """Time after which the error from the paper's initial state stays below 2 % of 1.5 mm, s."""
    time = np.linspace(0.0, 1.0, 1001)
    return measure.settling_time(time, one.error(one.initial_state(INITIAL), time), 0.0, BAND)


@measures("observer-matrix")
def matrix(runs: Runs) -> Finding:
    """Characteristic polynomial of A.7 as printed, with correct gains."""
    one = observer(runs.servo, ALPHA)
    gains, (a3, a2) = one.L, one.denominator[-2:-4:-1]
    printed = one.A.copy()
    printed[1, 0] = -(a3 + gains[1])
    right, from_print = _coefficients(one.A), _coefficients(printed)
    error = float(np.abs(from_print / right - 1.0).max())
    why = (
        f"with a3 in the second row the polynomial's s² coefficient is {from_print[2]:.5g} instead of {right[2]:.5g};"
        f" with a2 ({a2:.5g}) it is right"
    )
    return decided(error < 1e-9, why, ("largest relative error of a coefficient", error), *_poles(_roots(from_print)))


@measures("observer-gains")
def gains(runs: Runs) -> Finding:
    """Poles from A.9 as printed and as corrected."""
    one = observer(runs.servo, ALPHA)
    printed = _roots(_characteristic([comb(4, 4 - i) * ALPHA**i for i in range(4)]))
    corrected = _roots(_characteristic([comb(4, 4 - i) * ALPHA ** (4 - i) for i in range(4)]))
    spread = float(np.abs(corrected / -ALPHA - 1.0).max())
    why = (
        f"as printed, the poles lie between {printed.real.min():.3g} and {printed.real.max():.3g} 1/s; with α^(4-i) all"
        f" lie within {100 * spread:.2g} % of -40 1/s (a fourfold pole, to the accuracy of its computation)"
    )
    reproduced = bool(np.all(np.abs(printed / -ALPHA - 1.0) < 0.01))
    difference = float(
        np.abs(one.A[:, 0] + _characteristic([comb(4, i) * ALPHA ** (4 - i) for i in range(4)])[1:]).max()
    )
    return decided(reproduced, why, *_poles(printed), ("corrected gains against ours", difference))


def _characteristic(sums: list[float]) -> Array:
    """s^4 + ... with a_i + l_i as coefficients, i = 3 .. 0 (Eq A.8), highest power first."""
    return np.array([1.0, *sums[::-1]])


def _coefficients(matrix: Array) -> Array:
    """Characteristic polynomial, highest power first."""
    return np.asarray(np.poly(matrix), dtype=float)


def _roots(coefficients: Array) -> Complex:
    return np.asarray(np.roots(coefficients), dtype=complex)


def _poles(poles: Complex) -> list[tuple[str, float, str]]:
    """Fastest and slowest pole."""
    return [("fastest pole", float(poles.real.min()), "1/s"), ("slowest pole", float(poles.real.max()), "1/s")]
