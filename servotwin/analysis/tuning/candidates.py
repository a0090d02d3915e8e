"""All controllers of a type with a given crossover and phase margin, by the phases of their factors (as in pidtune).

    C(s) = K (s sin phz + wc cos phz) (s sin be + wc cos be) / (s (s sin al + wc cos al))

At s = j wc every bracket is wc exp(j angle): so the angles are phases, and abs(C(j wc)) = K.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotwin.analysis.tuning.response import FrequencyData, Plant, nyquist_stable
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.linear import Complex

# Filter time times crossover of types without a filter: the law needs one, so fast that it costs half a degree at most.
FASTEST_FILTER = 0.01


class ControllerType(NamedTuple):
    """Parts of a controller type: an integrator, a zero `phz`, a second zero `be`, a filter `al` to choose."""

    integral: bool
    zero: bool
    second_zero: bool
    filter: bool


CONTROLLER_TYPES = {
    "P": ControllerType(False, False, False, False),
    "PI": ControllerType(True, True, False, False),
    "PD": ControllerType(False, True, False, False),
    "PDF": ControllerType(False, True, False, True),
    "PID": ControllerType(True, True, True, False),
    "PIDF": ControllerType(True, True, True, True),
}


class Factors(NamedTuple):
    """K (V/m), the crossover wc (rad/s) and the angles phz, be, al (rad); be is 0 without a second zero."""

    K: float
    wc: float
    phz: float
    be: float
    al: float
    integral: bool

    def controller(self) -> Controller:
        """The gains of the law that equals C(s); the filter's time is tan(al) / wc."""
        Kp, Ki, Kd, time = (float(value) for value in _gains(self))
        # Without derivative action the filter has no input, but the law's filter time must be positive.
        return Controller(Kp, Ki, Kd, time if time > 0.0 else FASTEST_FILTER / self.wc)

    @property
    def cancellation(self) -> float:
        """abs(Kp) + abs(Kd) / Tf over abs(C(j wc)) where they act against one another by their signs; 0 elsewhere.

        An error of 1 % of one of the gains is up to that many per cent of the controller.
        """
        Kp, _, Kd, time = (float(value) for value in _gains(self))
        return (abs(Kp) + abs(Kd) / time) / abs(self.K) if Kp * Kd < 0.0 else 0.0

    def response(self, omega: ArrayLike) -> Complex:
        """C(j omega)."""
        s, w = 1j * np.asarray(omega, dtype=float), self.wc
        first = s * np.sin(self.phz) + w * np.cos(self.phz)
        second = s * np.sin(self.be) + w * np.cos(self.be)
        below = s * np.sin(self.al) + w * np.cos(self.al)
        return np.asarray(self.K * first * second / (below * (s if self.integral else w)))


def _gains(factors: Factors) -> tuple[float, float, float, float]:
    """Kp, Ki, Kd, Tf by comparing coefficients over s (Tf s + 1)."""
    K, wc, phz, be, al, integral = factors
    time = math.tan(al) / wc
    below = wc * math.cos(al)
    square = K * math.sin(phz) * math.sin(be) / below
    linear = K * wc * math.sin(phz + be) / below
    constant = K * wc**2 * math.cos(phz) * math.cos(be) / below
    if not integral:
        # Without the integrator the same numerator stands over wc (Tf s + 1).
        square, linear, constant = 0.0, linear / wc, constant / wc
        return constant, 0.0, linear - constant * time, time
    Kp = linear - constant * time
    return Kp, constant, square - Kp * time, time


# Angles of a grid, and how often it is repeated, each time a quarter as wide, about the best.
_ANGLES, _ZOOMS = 16, 4
# Filters from 1 to 89 deg; the second zero from infinity (0 deg) to nearly 0 (89 deg).
_LOWEST, _HIGHEST = math.radians(1.0), math.radians(89.0)
# A larger `Factors.cancellation` is no setting of a machine: the published servo has 3, and a lag by a filter far below
# the crossover thousands.
_MOST_CANCELLATION = 10.0


class Candidate(NamedTuple):
    """A stable candidate; `integral` is abs(Ki), and without integral action abs(Kp)."""

    factors: Factors
    Ms: float
    integral: float


class ControllerSearch(NamedTuple):
    """The stable candidates, at least one, and the number of candidates evaluated."""

    stable: list[Candidate]
    evaluated: int


def search(plant: Plant, name: str, wc: float, margin: float, cost: Callable[[Candidate], float]) -> ControllerSearch:
    """Search the stable candidates of a type for a crossover (rad/s) and a phase margin (rad), densest where `cost` is
    low.

    Raises
    ------
    InvalidInput
        The type cannot give this margin at this crossover, or no candidate is stable.
    """
    kind, at = CONTROLLER_TYPES[name], _at_crossover(plant, wc)
    omega = plant.search_frequencies(wc)
    values = plant.response(omega)
    possible = cancelling = False
    # Positive gains first; a plant of negative gain needs negative ones.
    for sign in (1.0, -1.0):
        turn = _wrapped(margin - math.pi - np.angle(sign * at))
        if name == "P":
            turn = 0.0 if _wrapped(math.pi + np.angle(sign * at)) >= margin else math.nan
        stable: list[Candidate] = []
        count = 0
        be, al = (0.5 * _HIGHEST, _HIGHEST), (0.5 * (_LOWEST + _HIGHEST), _HIGHEST - _LOWEST)
        for zoom in range(_ZOOMS):
            grid = _grid(kind, wc, turn, sign / abs(at), be, al, zoom)
            kept = [factors for factors in grid if factors.cancellation <= _MOST_CANCELLATION]
            cancelling, grid = cancelling or len(kept) < len(grid), kept
            if not grid:
                break
            count, possible = count + len(grid), True
            stable += _stable_candidates(grid, omega, values, plant.integrators)
            if not stable:
                break
            best = min(stable, key=cost).factors
            be, al = (best.be, _HIGHEST / 4 ** (zoom + 1)), (best.al, _HIGHEST / 4 ** (zoom + 1))
        if stable:
            return ControllerSearch(stable, count)
    if not (possible or cancelling):
        raise InvalidInput(_unreachable(name, kind, wc, margin, at))
    where = f"crossover of {wc:g} rad/s with a phase margin of {math.degrees(margin):g} deg"
    limit = f"together are over {_MOST_CANCELLATION:g} times its gain there"
    but = f" without Kp and Kd / Tf that act against one another and {limit}" if cancelling else ""
    raise InvalidInput(f"no stable {name} controller gives this plant a {where}{but}")


def _at_crossover(plant: Plant, wc: float) -> complex:
    if isinstance(plant.system, FrequencyData):
        omega = np.asarray(plant.system.omega, dtype=float)
        if not omega[0] <= wc <= omega[-1]:
            where = f"{omega[0]:g} to {omega[-1]:g} rad/s"
            raise InvalidInput(f"crossover = {wc:g} rad/s: outside the frequency data, which cover {where}")
    value = complex(plant.response(wc))
    if not (math.isfinite(abs(value)) and abs(value) > 0.0):
        raise InvalidInput(f"crossover = {wc:g} rad/s: the plant's response there is {value}; no gain makes it 1")
    return value


def _grid(
    kind: ControllerType, wc: float, turn: float, K: float, be: tuple[float, float], al: tuple[float, float], zoom: int
) -> list[Factors]:
    """Candidates on a grid about (centre, width) of the two free angles, as far as phz is a zero's angle."""
    bes = _angles(*be, 0.0, zoom) if kind.second_zero else np.zeros(1)
    fixed = math.atan(FASTEST_FILTER) if kind.second_zero or (kind.zero and not kind.integral) else 0.0
    als = _angles(*al, _LOWEST, zoom) if kind.filter else np.array([fixed])
    quarter = 0.5 * math.pi if kind.integral else 0.0
    pairs = [(float(b), float(a)) for b in bes for a in als]
    angles = [(turn + quarter + a - b, b, a) for b, a in pairs]
    # be <= phz: the two zeros are alike.
    good = [(p, b, a) for p, b, a in angles if b <= p <= _HIGHEST] if kind.zero else [(turn, 0.0, 0.0)]
    return [Factors(K, wc, p, b, a, kind.integral) for p, b, a in good if not math.isnan(p)]


def _angles(centre: float, width: float, lowest: float, zoom: int) -> Array:
    """Angles about a centre within the allowed range; a zoomed grid holds its centre."""
    count = _ANGLES if zoom == 0 else _ANGLES // 2 + 1
    grid = np.linspace(centre - 0.5 * width, centre + 0.5 * width, count)
    return np.unique(np.clip(grid, lowest, _HIGHEST))


def _stable_candidates(grid: list[Factors], omega: Array, plant: Complex, integrators: int) -> list[Candidate]:
    loops = np.array([factors.response(omega) for factors in grid]) * plant
    stable = nyquist_stable(loops, integrators + grid[0].integral)
    Ms = np.max(1.0 / np.abs(1.0 + loops), axis=1)
    candidates = []
    for factors, good, peak in zip(grid, stable, Ms, strict=True):
        if good:
            law = factors.controller()
            candidates.append(Candidate(factors, float(peak), abs(law.Ki) or abs(law.Kp)))
    return candidates


def _wrapped(angle: float) -> float:
    return float((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _unreachable(name: str, kind: ControllerType, wc: float, margin: float, at: complex) -> str:
    low = (-90.0 if kind.integral else 0.0) - (90.0 if kind.filter else 0.0)
    high = low + 90.0 * (kind.zero + kind.second_zero + kind.filter)
    phase = math.degrees(float(np.angle(at)))
    turns = f"by {low:g} to {high:g} deg" if high > low else "not at all"
    return (
        f"phase margin = {math.degrees(margin):g} deg cannot be reached at {wc:g} rad/s with a {name} controller: "
        f"the plant's phase there is {phase:.1f} deg (modulo 360), and the controller turns it {turns}"
    )
