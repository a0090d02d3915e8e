"""Checked numbers of a plant."""

from __future__ import annotations

import math

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.signals import check_gap


def tolerance_of(p: float, gap: float, k_dz: float) -> float:
    """Dead-zone half-width (m) for a total gap (rad) behind a pitch (m/rad): k_dz p gap (Eq 21).

    Raises
    ------
    InvalidInput
        The gap or k_dz is negative or not finite, or the gap is above one turn.
    """
    for name, value, unit in (("gap", gap, "rad"), ("k_dz", k_dz, "tolerances per gap")):
        if not (math.isfinite(value) and value >= 0.0):
            raise InvalidInput(f"{name} = {value} {unit}: must be finite and 0 or more")
    check_gap(gap)
    return k_dz * p * gap


def a_number(described: str, name: str, value: object) -> float:
    """Return a value as a float.

    Raises
    ------
    InvalidInput
        It is no number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InvalidInput(f"{described} {name} = {value!r}: must be a number")
    return float(value)
