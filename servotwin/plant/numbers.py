"""Checked numbers of a plant."""

from __future__ import annotations

import math

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.signals import LARGEST_GAP, check_gap


def tolerance_of(p: float, gap: float, k_dz: float, largest: float = LARGEST_GAP) -> float:
    """Dead-zone half-width (m) for a total gap (rad) behind a pitch (m/rad): k_dz p gap (Eq 21).

    Raises
    ------
    InvalidInput
        The gap or k_dz is negative or not finite, or the gap is above the largest one.
    """
    for name, value, unit in (("gap", gap, "rad"), ("k_dz", k_dz, "tolerances per gap")):
        if not (math.isfinite(value) and value >= 0.0):
            raise InvalidInput(f"{name} = {value} {unit}: must be finite and 0 or more")
    check_gap(gap, largest=largest)
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


def check_stribeck(
    described: str,
    coulomb: float,
    static: float | None,
    speed: float | None,
    keys: tuple[str, str, str, str],
) -> None:
    """Refuse a static friction that does not fit the Coulomb friction, or one without a speed.

    Parameters
    ----------
    described : str
        Table of the keys.
    coulomb, static, speed : float or None
    keys : tuple of str
        Keys of the three, and the unit of the first two.

    Raises
    ------
    InvalidInput
        Only one of static friction and Stribeck speed is given, a static friction is below the Coulomb friction, or
        there is no Coulomb friction.
    """
    fixed, above, falls, unit = keys
    if (static is None) != (speed is None):
        given, missing = (above, falls) if speed is None else (falls, above)
        raise InvalidInput(
            f"{described} {given}: needs {missing} too; give both, or neither for Coulomb friction alone"
        )
    if static is None or speed is None:
        return
    if not (math.isfinite(speed) and speed > 0.0):
        raise InvalidInput(f"{described} {falls} = {speed!r}: must be finite and positive")
    if not (math.isfinite(static) and static >= coulomb > 0.0):
        raise InvalidInput(
            f"{described} {above} = {static!r} {unit}: must be at least {fixed} = {coulomb!r} {unit}, "
            "which must be above 0"
        )
