"""Load of an axis: a chain of masses or inertias, on the ground or free."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.numbers import a_number, check_stribeck
from servotwin.plant.signals import Array

LINEAR, ROTARY = "linear", "rotary"
_UNITS = {LINEAR: ("kg", "N/m", "N s/m", "N"), ROTARY: ("kg m^2", "N m/rad", "N m s/rad", "N m")}

_KEYS = {
    LINEAR: {"m": "mass_kg", "k": "stiffness_n_per_m", "c": "damping_n_s_per_m"},
    ROTARY: {"m": "inertia_kg_m2", "k": "stiffness_n_m_per_rad", "c": "damping_n_m_s_per_rad"},
}
_FRICTION_KEYS = {
    LINEAR: ("friction_n", "static_friction_n", "stribeck_speed_m_per_s", "N"),
    ROTARY: ("friction_n_m", "static_friction_n_m", "stribeck_speed_rad_per_s", "N m"),
}


@dataclass(frozen=True)
class Load:
    """Masses on springs and dampers, from the transmission outwards; the last one's position is controlled.

    Parameters
    ----------
    m : tuple of float
        n masses, kg; of a rotary load inertias, kg m^2.
    k, c : tuple of float
        n stiffnesses and dampings, N/m and N s/m (rotary: N m/rad and N m s/rad). The first of each is between the
        first mass and the ground (0: a free load, and one without viscous friction), the others between a mass and the
        one before it.
    motion : {"linear", "rotary"}
    friction : float
        Coulomb friction on the last mass, N (rotary: N m).
    force : float
        Constant force on the last mass, gravity for one, N (rotary: N m); positive pushes forwards.
    static : float, optional
        Friction at standstill, N (rotary: N m); None: the Coulomb friction.
    stribeck : float, optional
        Speed at which the friction has fallen, linearly, from the static to the Coulomb friction, m/s (rotary: rad/s).

    Raises
    ------
    InvalidInput
        A value out of its range, or numbers of values that differ.
    """

    m: tuple[float, ...]
    k: tuple[float, ...] = (0.0,)
    c: tuple[float, ...] = (0.0,)
    motion: str = LINEAR
    friction: float = 0.0
    force: float = 0.0
    static: float | None = None
    stribeck: float | None = None

    def __post_init__(self) -> None:
        if self.motion not in _UNITS:
            raise InvalidInput(f'load motion = {self.motion!r}: must be "linear" or "rotary"')
        for name, unit in zip(("m", "k", "c"), _UNITS[self.motion], strict=False):
            given = getattr(self, name)
            if not isinstance(given, tuple | list | np.ndarray):
                raise InvalidInput(f"load {name} = {given!r}: must be a tuple of one number for each mass")
            values = tuple(a_number("load", f"{name}[{i}]", value) for i, value in enumerate(given))
            object.__setattr__(self, name, values)
            if len(values) != len(self.m) or not values:
                raise InvalidInput(
                    f"load {self.described(name)} = {values}: must have one value for each of the {len(self.m)} masses"
                )
            for i, value in enumerate(values):
                least = "positive" if self._positive(name, i) else "0 or more"
                if not (math.isfinite(value) and (value > 0.0 if least == "positive" else value >= 0.0)):
                    raise InvalidInput(
                        f"load {name}[{i}] ({self.key(name)}) = {value!r} {unit}: must be finite and {least}"
                    )

        for name in ("friction", "force"):
            object.__setattr__(self, name, a_number("load", name, getattr(self, name)))
        unit = _UNITS[self.motion][3]
        if not (math.isfinite(self.friction) and self.friction >= 0.0):
            raise InvalidInput(f"load friction = {self.friction!r} {unit}: must be finite and 0 or more")
        if not math.isfinite(self.force):
            raise InvalidInput(f"load force = {self.force!r} {unit}: must be finite")
        check_stribeck("load", self.friction, self.static, self.stribeck, _FRICTION_KEYS[self.motion])

    def described(self, name: str) -> str:
        """Name of m, k or c with its key in a file."""
        return f"{name} ({self.key(name)})"

    def key(self, name: str) -> str:
        """Key of m, k, c, friction or static in a file."""
        frictions = dict(zip(("friction", "static"), _FRICTION_KEYS[self.motion], strict=False))
        return frictions.get(name) or _KEYS[self.motion][name]

    @staticmethod
    def _positive(name: str, place: int) -> bool:
        return name == "m" or (name == "k" and place > 0)

    @property
    def n(self) -> int:
        """Number of masses."""
        return len(self.m)

    @property
    def free(self) -> bool:
        """True where no spring holds the load to the ground."""
        return self.k[0] == 0.0

    @property
    def masses(self) -> Array:
        """(n,) kg or kg m^2."""
        return np.array(self.m)

    @property
    def stiffnesses(self) -> Array:
        """(n,) N/m or N m/rad."""
        return np.array(self.k)

    @property
    def dampings(self) -> Array:
        """(n,) N s/m or N m s/rad."""
        return np.array(self.c)
