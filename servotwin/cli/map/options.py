"""Options of `servotwin map`, parsed into settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from servotwin.analysis.maps.axes import Axes, PhysicalAxes, RatioAxes, Values
from servotwin.analysis.maps.settings import MapSettings
from servotwin.cli.gap_options import GapForm, stated_gap
from servotwin.cli.own_options import option_of, own_option
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.display_units import position_unit
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant, resolve_plant

_MAX_VALUES = 4096
_MAX_PANELS = 36
TOLERANCE, AMPLITUDE = "0:5:64", "0.5:500:64:log"


@dataclass(frozen=True)
class MapOptions:
    """The options of `servotwin map` that the numbers depend on; None: not given. `at_load`: gaps there, by key."""

    servo: str
    tolerance: str | None = None
    amplitude: str | None = None
    gap_deg: str | None = None
    estimate_deg: str | None = None
    at_load: Mapping[str, str] = field(default_factory=dict)
    k_dz: str | None = None
    amplitude_mm: str | None = None
    amplitude_deg: str | None = None
    enter: float | None = None
    leave: float | None = None
    members: int = 16
    motion: float = 1.0
    seed: int = 0
    duration: float | None = None
    window: float | None = None
    still_um: float | None = None
    still_mdeg: float | None = None

    def settings(self) -> MapSettings:
        """Settings of the map.

        Raises
        ------
        InvalidInput
            An option is outside its range, or the two kinds of axes are mixed.
        """
        servo = resolve_plant(self.servo)
        own = servo.controller
        if isinstance(own, LinearLaw) and own.discrete:
            raise InvalidInput(
                f"{self.servo} controller: has discrete matrices, and maps are those of the law in continuous time; "
                "give matrices of continuous time"
            )
        enter = own.enter if self.enter is None else self.enter
        leave = own.leave if self.leave is None else self.leave
        law = own.replace(sample_rate=None, rate_limit=None, enter=enter, leave=leave)
        axes = self._axes(servo)
        _check_drawable(axes.shape)
        return MapSettings(
            servo,
            axes,
            law,
            members=self.members,
            motion=self.motion,
            seed=self.seed,
            duration=self.duration,
            window=self.window,
            still=self._still(servo),
        )

    def _still(self, servo: Plant) -> float | None:
        """Largest half peak-to-peak of a rest, m or rad."""
        value = own_option(
            {"still_um": self.still_um, "still_mdeg": self.still_mdeg}, "still_um", self.servo, own_units(servo)
        )
        return None if value is None else position_unit(servo).small.si_of(value)

    def _axes(self, servo: Plant) -> Axes:
        units = own_units(servo)
        ratios = {"--tolerance": self.tolerance, "--amplitude": self.amplitude}
        (gap, gaps), (estimate, estimates) = self._gap("gap", servo), self._gap("estimate", servo)
        physical = {gap.option: gaps, estimate.option: estimates, "--k-dz": self.k_dz}
        steps = {"amplitude_mm": self.amplitude_mm, "amplitude_deg": self.amplitude_deg}
        own = option_of(units.key("amplitude_mm"))
        physical[own] = own_option(steps, "amplitude_mm", self.servo, units)
        given = [[name for name, text in group.items() if text is not None] for group in (ratios, physical)]
        if all(given):
            raise InvalidInput(
                f"{given[0][0]} is in units of p b and {given[1][0]} is not: give axes of one kind, {', '.join(ratios)}"
                f" or {', '.join(physical)}"
            )
        if not given[1]:
            return self._ratios()
        return PhysicalAxes(
            parsed(gap.option, gaps or "10", gap.at_motor(1.0)),
            parsed("--k-dz", self.k_dz or "1"),
            parsed(own, physical[own] or "1", position_unit(servo).si_of(1.0)),
            () if estimates is None else parsed(estimate.option, estimates, estimate.at_motor(1.0)),
        )

    def _gap(self, name: str, servo: Plant) -> tuple[GapForm, str | None]:
        degrees = self.gap_deg if name == "gap" else self.estimate_deg
        return stated_gap(name, degrees, self.at_load, self.servo, servo)

    def _ratios(self) -> RatioAxes:
        tolerance = parsed("--tolerance", self.tolerance or TOLERANCE)
        return RatioAxes(tolerance, parsed("--amplitude", self.amplitude or AMPLITUDE))


def parsed(name: str, text: str, unit: float = 1.0) -> Values:
    """Parse an axis: "LOW:HIGH:COUNT", evenly spaced, with ":log" in equal ratios, or "VALUE,VALUE,...".

    Parameters
    ----------
    name : str
        The option, for messages.
    text : str
    unit : float
        Multiplies every value.

    Raises
    ------
    InvalidInput
        The text is neither, or a range is empty or out of order.
    """
    values = _ranged(name, text) if ":" in text else [_number(name, text, part) for part in text.split(",")]
    return tuple(value * unit for value in values)


def _ranged(name: str, text: str) -> list[float]:
    low, high, count, *kind = text.split(":") if text.count(":") in (2, 3) else ("", "", "")
    if kind not in ([], ["log"]) or not count.strip().isdecimal():
        raise _invalid_axis(name, text)
    first, last, size = _number(name, text, low), _number(name, text, high), int(count)
    if not (2 <= size <= _MAX_VALUES and first < last and (first > 0.0 or not kind)):
        raise InvalidInput(
            f"{name} {text!r}: a range goes up, has 2 to {_MAX_VALUES} values and, with :log, starts above 0"
        )
    return (np.geomspace if kind else np.linspace)(first, last, size).tolist()


def _number(name: str, text: str, part: str) -> float:
    try:
        value = float(part)
    except ValueError:
        raise _invalid_axis(name, text) from None
    if not math.isfinite(value):
        raise _invalid_axis(name, text)
    return value


def _invalid_axis(name: str, text: str) -> InvalidInput:
    return InvalidInput(
        f"{name} {text!r}: is no list of values; give LOW:HIGH:COUNT, LOW:HIGH:COUNT:log or VALUE,VALUE,..."
    )


def _check_drawable(shape: Sequence[int]) -> None:
    """Refuse axes that no picture can show."""
    varying = sorted((size for size in shape if size > 1), reverse=True)
    if not varying:
        raise InvalidInput("map axes: every axis has one value; give a range to one of them at least")
    if math.prod(varying[2:]) > _MAX_PANELS:
        raise InvalidInput(
            f"map axes: {' x '.join(map(str, varying))} values are {math.prod(varying[2:])} panels beside the two"
            f" longest axes; give at most {_MAX_PANELS}"
        )
