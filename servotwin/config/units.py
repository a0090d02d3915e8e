"""Units of keys, which the ends of their names say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of a key, and the one that its attribute has: attribute = key * factor / divisor."""

    name: str
    si: str
    factor: float = 1.0
    divisor: float = 1.0

    @property
    def exact(self) -> bool:
        """True where the key has the attribute's unit, so that conversion loses no digit."""
        return self.factor == self.divisor == 1.0

    def to_si(self, value: float) -> float:
        """The attribute's value."""
        return value * self.factor / self.divisor

    def from_si(self, value: float) -> float:
        """The key's value that `to_si` converts to this one; the nearest where no float does so exactly."""
        near = value * self.divisor / self.factor
        close = (near, math.nextafter(near, math.inf), math.nextafter(near, -math.inf))
        return next((number for number in close if self.to_si(number) == value), near)


_DEGREE = math.pi / 180.0
_SCALED = {
    "mm_per_s": Unit("mm/s", "m/s", 1e-3),
    "mm": Unit("mm", "m", 1e-3),
    "um": Unit("µm", "m", 1e-6),
    "deg_per_s": Unit("deg/s", "rad/s", _DEGREE),
    "deg": Unit("deg", "rad", _DEGREE),
    "mdeg": Unit("mdeg", "rad", 1e-3 * _DEGREE),
    "arcmin": Unit("arcmin", "rad", _DEGREE, 60.0),
    "mv": Unit("mV", "V", 1e-3),
    "mn_m": Unit("mN m", "N m", 1e-3),
    "mrad_per_s": Unit("mrad/s", "rad/s", 1e-3),
    "mrad": Unit("mrad", "rad", 1e-3),
    "mm_per_rev": Unit("mm/rev", "m/rad", 1e-3, 2.0 * math.pi),
    "percent": Unit("%", "", divisor=100.0),
    "megabytes": Unit("MB", "bytes", 1e6),
}
_PLAIN = {
    "s": "s", "hz": "Hz", "v": "V", "m": "m", "rad": "rad", "kg": "kg", "h": "H", "ohm": "ohm", "n_m": "N m",
    "m_per_s": "m/s", "rad_per_s": "rad/s", "v_per_s": "V/s", "v_per_m": "V/m", "v_per_m_s": "V/(m s)",
    "v_s_per_m": "V s/m", "kg_m2": "kg m^2", "n_m_per_a": "N m/A", "v_s_per_rad": "V s/rad", "m_per_rad": "m/rad",
    "n_per_m": "N/m", "n_s_per_m": "N s/m", "per_s": "1/s", "per_minute": "1/min", "days": "days", "bytes": "bytes",
    "tolerances": "tolerances", "n_m_per_rad": "N m/rad", "n_m_s_per_rad": "N m s/rad", "n": "N",
    "v_s2_per_rad": "V s^2/rad", "n_m_s2_per_rad": "N m s^2/rad",
}  # fmt: skip
# Gains of axes: command per position, by time or with it.
for _command, _per in (("v", "V"), ("n_m", "N m"), ("rad_per_s", "rad/s"), ("rad", "rad")):
    _PLAIN[f"{_command}_per_s"] = f"{_per}/s" if "/" not in _per else "rad/s^2"
    for _position in ("m", "rad"):
        _top = _per.removesuffix("/s")
        _bottom = f"({_position} s)" if _top != _per else _position
        _PLAIN[f"{_command}_per_{_position}"] = f"{_top}/{_bottom}"
        _PLAIN[f"{_command}_per_{_position}_s"] = f"{_top}/({_position} s{'^2' if _top != _per else ''})"
        _PLAIN[f"{_command}_s_per_{_position}"] = f"{_top}/{_position}" if _top != _per else f"{_per} s/{_position}"
_SUFFIXES = {**_SCALED, **{suffix: Unit(name, name) for suffix, name in _PLAIN.items()}}


@cache
def suffix_of(name: str) -> str:
    """The end of a key's name that says its unit; empty for a key without."""
    fitting = (suffix for suffix in _SUFFIXES if name == suffix == "megabytes" or name.endswith(f"_{suffix}"))
    return max(fitting, key=len, default="")


def unit_of(name: str) -> Unit:
    """The unit that the end of a key's name says; none for a key without."""
    return _SUFFIXES.get(suffix_of(name), Unit("", ""))


_POSITIONS = ("m", "rad", "mm", "deg")
SIGNAL_COLUMNS = {
    "position": tuple(f"{name}_{unit}" for name in ("measured_position", "position") for unit in _POSITIONS),
    "theta_m": ("measured_theta_m_rad", "theta_m_rad", "theta_m_deg"),
    "voltage": ("voltage_v", "command_n_m", "command_rad_per_s", "command_rad"),
    "reference": tuple(f"reference_{unit}" for unit in _POSITIONS),
}
"""Columns of logs by signal, in order of preference: what was measured before what was true."""
COMMAND_COLUMNS = {unit_of(name).si: name for name in SIGNAL_COLUMNS["voltage"]}
"""Columns of commands in logs, by unit."""
