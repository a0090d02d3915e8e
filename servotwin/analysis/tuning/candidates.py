"""All controllers of a type with a given crossover and phase margin, on a grid of their free angles, zoomed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servotwin.analysis.tuning.factors import FASTEST_FILTER, KINDS, Factors, Kind
from servotwin.analysis.tuning.response import FrequencyData, Plant, circled
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.linear import Complex

# Angles of a grid, and how often it is repeated, each time a quarter as wide, about the best.
_ANGLES, _ZOOMS = 16, 4
# Filters from 1 to 89 deg; the second zero from infinity (0 deg) to nearly 0 (89 deg).
_LOWEST, _HIGHEST = math.radians(1.0), math.radians(89.0)


class Candidate(NamedTuple):
    """A stable candidate; `integral` is abs(Ki), and without integral action abs(Kp)."""

    factors: Factors
    Ms: float
    integral: float


class Found(NamedTuple):
    """The stable candidates, at least one, and how many were looked at and stable."""

    kept: list[Candidate]
    looked_at: int
    stable: int


def search(plant: Plant, name: str, wc: float, margin: float, cost: Callable[[Candidate], float]) -> Found:
    """All stable candidates of a type for a crossover (rad/s) and a phase margin (rad), more of them where `cost` is
    low.

    Raises
    ------
    InvalidInput
        The type cannot give this margin at this crossover, or no candidate is stable.
    """
    kind, at = KINDS[name], _at_crossover(plant, wc)
    omega = plant.looks(wc)
    values = plant.response(omega)
    possible = False
    for sign in (1.0, -1.0):
        turn = _wrapped(margin - math.pi - np.angle(sign * at))
        if name == "P":
            turn = 0.0 if _wrapped(math.pi + np.angle(sign * at)) >= margin else math.nan
        kept: list[Candidate] = []
        count = 0
        be, al = (0.5 * _HIGHEST, _HIGHEST), (0.5 * (_LOWEST + _HIGHEST), _HIGHEST - _LOWEST)
        for zoom in range(_ZOOMS):
            grid = _grid(kind, wc, turn, sign / abs(at), be, al, zoom)
            if not grid:
                break
            count, possible = count + len(grid), True
            kept += _judged(grid, omega, values, plant.integrators)
            if not kept:
                break
            best = min(kept, key=cost).factors
            be, al = (best.be, _HIGHEST / 4 ** (zoom + 1)), (best.al, _HIGHEST / 4 ** (zoom + 1))
        if kept:
            return Found(kept, count, len(kept))
    if not possible:
        raise InvalidInput(_unreachable(name, kind, wc, margin, at))
    where = f"{wc:g} rad/s and {math.degrees(margin):g} deg there"
    raise InvalidInput(f"no {name} controller with its crossover at {where} is stable on this plant")


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
    kind: Kind, wc: float, turn: float, K: float, be: tuple[float, float], al: tuple[float, float], zoom: int
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


def _judged(grid: list[Factors], omega: Array, plant: Complex, integrators: int) -> list[Candidate]:
    loops = np.array([factors.response(omega) for factors in grid]) * plant
    stable = circled(loops, integrators + grid[0].integral)
    Ms = np.max(1.0 / np.abs(1.0 + loops), axis=1)
    kept = []
    for factors, good, peak in zip(grid, stable, Ms, strict=True):
        if good:
            law = factors.controller()
            kept.append(Candidate(factors, float(peak), abs(law.Ki) or abs(law.Kp)))
    return kept


def _wrapped(angle: float) -> float:
    return float((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _unreachable(name: str, kind: Kind, wc: float, margin: float, at: complex) -> str:
    low = (-90.0 if kind.integral else 0.0) - (90.0 if kind.filter else 0.0)
    high = low + 90.0 * (kind.zero + kind.second_zero + kind.filter)
    phase = math.degrees(float(np.angle(at)))
    turns = f"by {low:g} to {high:g} deg" if high > low else "not at all"
    return (
        f"phase margin = {math.degrees(margin):g} deg cannot be had at {wc:g} rad/s with a {name} controller: "
        f"the plant's phase there is {phase:.1f} deg (modulo 360), and the controller turns it {turns}"
    )
