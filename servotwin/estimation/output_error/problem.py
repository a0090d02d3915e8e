"""A window with a model of it, and the grid of starts of its fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servotwin.estimation.core.motor_angle import noise_of
from servotwin.estimation.output_error.models import DELAY, HALF, OFFSET, Flags, Motion, MotionModel, usual_sizes
from servotwin.estimation.output_error.play_model import PlayModel
from servotwin.estimation.output_error.refined import refined
from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array

LARGEST = 4.0  # standard deviations by which an unknown may move
_LARGEST_DELAY = 0.03  # of the window
_HARDLY_KNOWN = math.log(100.0)  # of dampings: no data sheet states that of a shaft
_HALVES = (0.5, 0.4, 0.3, 0.22, 0.15, 0.1, 0.06, 0.03, 0.015, 0.005)  # of the lead's range
_PLACES = tuple(0.1 * step for step in range(-5, 6))  # of the lead's range
_WIDE = 5.0  # of the lead's range
_SLOW = 0.1  # of the motor's largest speed
_MOVED, _FEWEST = 0.02, 8  # of the window: what shows the first speed; samples
_ON_A_LINE = 1.5  # times the noise, or a count: what a line leaves of them
_REMEMBERED = 2  # delays: that of the unknowns, and the moved one of their derivatives
_SHARPEST = 0.1  # of the window: larger parts in which the motor's speed jumps are its usual motion


@dataclass(frozen=True, eq=False)
class Problem:
    """A window and a model of it.

    Attributes
    ----------
    model : MotionModel
    drive, position : (N,) arrays
        Motor's angle times the transmission's ratio, and measured position; m or rad.
    interval : float
        s.
    count : float
        One count of either channel, seen at the load.
    parts : int
        Of each interval, at which the model is told the motor's place.
    """

    model: MotionModel
    drive: Array
    position: Array
    interval: float
    count: float
    parts: int = 1

    @property
    def duration(self) -> float:
        """Of the window, s."""
        return self.interval * self.position.size

    @cached_property
    def lead(self) -> Array:
        """(N,) motor before the load."""
        return np.asarray(self.drive - self.position)

    @cached_property
    def range(self) -> float:
        """Of the lead."""
        return float(np.ptp(self.lead))

    @cached_property
    def margin(self) -> int:
        """Samples at either end that do not count, because of the delay."""
        return 1 + math.ceil(self.largest_delay / self.interval)

    @cached_property
    def largest_delay(self) -> float:
        """s."""
        known = LARGEST * self.model.unknowns[DELAY].std
        return min(known, _LARGEST_DELAY * self.duration)

    def sizes(self) -> Array:
        """(u,) usual sizes of the unknowns."""
        return usual_sizes(self.model.unknowns, self.range, self.duration, self.interval)

    def limits(self) -> Array:
        """(u,) largest sizes of the unknowns."""
        limits = np.array([LARGEST * unknown.std for unknown in self.model.unknowns])
        limits[DELAY] = self.largest_delay
        dampings = ["damping" in unknown.name for unknown in self.model.unknowns]
        limits[dampings] = np.maximum(limits[dampings], _HARDLY_KNOWN)
        return limits

    def motion(self, values: Array, rate: float = 0.0) -> Motion:
        """Simulate the window; `rate` (1/s) of the observer, 0: none.

        The motor's angle is delayed in place of the position: the load's motion begins with the first sample.
        """
        position, velocity, driven, sides = self.under(self.late_drive(values), values, rate)
        step = self.parts
        return Motion(position[::step], velocity[::step], driven[::step], sides[::step])

    def under(self, drive: Array, values: Array, rate: float = 0.0) -> Motion:
        """Motion under another drive, at all parts of the intervals, ((N - 1) parts + 1,)."""
        return self.model.simulate(drive, self._measured, self.interval / self.parts, values, rate)

    def misfit(self, values: Array, rate: float = 0.0) -> Array:
        """(m,) position of the model, predicted by the observer if there is one, less the measured one."""
        drive, interval = self.late_drive(values), self.interval / self.parts
        return self.less_measured(self.model.position(drive, self._measured, interval, values, rate))

    def misfits(self, points: list[Array], rate: float = 0.0) -> list[Array]:
        """`misfit` (m,) at several points."""
        return [self.misfit(values, rate) for values in points]

    def misfit_in_growing_gap(self, values: Array, sizes: Array) -> Array:
        """`misfit` (m,) of a model without dynamics whose gap has `sizes` (N,), shares of the one in the unknowns."""
        assert isinstance(self.model, PlayModel)
        drive = self.late_drive(values)
        return self.less_measured(self.model.position_in_growing_gap(drive, self.interval, values, sizes))

    def late_drive(self, values: Array) -> Array:
        """Motor ((N - 1) parts + 1,) as late as the unknowns (u,) say; most derivatives move another unknown than the
        delay."""
        late, known = float(values[DELAY]) / self.interval * self.parts, self._late
        if late not in known:
            if len(known) == _REMEMBERED:
                known.pop(next(iter(known)))
            known[late] = delayed(self._refined, late)
        return known[late]

    @cached_property
    def _refined(self) -> Array:
        """Motor at all parts of the intervals, ((N - 1) parts + 1,)."""
        return self.drive if self.parts == 1 else refined(self.drive, self.parts)

    @cached_property
    def _measured(self) -> Array:
        """Position there, straight between samples, for the slow observer."""
        if self.parts == 1:
            return self.position
        at = np.arange((self.position.size - 1) * self.parts + 1) / self.parts
        return np.interp(at, np.arange(self.position.size), self.position)

    @cached_property
    def _late(self) -> dict[float, Array]:
        """The motor ((N - 1) parts + 1,) as late by numbers of parts, the last few."""
        return {}

    def less_measured(self, position: Array) -> Array:
        """A model's position ((N - 1) parts + 1,) less the measured one, (m,)."""
        misfit = np.asarray((position[:: self.parts] - self.position)[self.margin : self.drive.size - self.margin])
        misfit[self.unsure] = 0.0
        return misfit

    @cached_property
    def unsure(self) -> Flags:
        """(m,) samples near which the motor's speed jumps: its place between two samples is not known there.

        A delay moves the load by as much as interpolation errs: by what a parabola through three samples differs from
        two lines. Without dynamics the load shows that at once; where it is less than the noise it does not matter.
        """
        size, reach = self.drive.size - 2 * self.margin, self.margin
        if self.model.speed > 0.0:
            return np.zeros(size, dtype=bool)
        between = np.abs(np.diff(self.drive, 2)) / 8.0
        sharp = between > max(noise_of(self.position), self.count / math.sqrt(12.0))
        near = np.convolve(sharp, np.ones(2 * reach - 1), "valid")[:size] > 0.5
        return near if float(np.mean(near)) < _SHARPEST else np.zeros(size, dtype=bool)

    def first(self) -> tuple[float, float]:
        """First position and speed of the load, by a line through the first samples where it has dynamics."""
        if self.model.speed == 0.0:
            return float(self.position[0]), 0.0
        size = max(_FEWEST, round(_MOVED * self.position.size))
        slope, value = np.polyfit(self.interval * np.arange(size), self.position[:size], 1)
        return float(value), float(slope)

    @property
    def free(self) -> Flags:
        """(u,) unknowns that are fitted: all."""
        return np.ones(len(self.model.unknowns), dtype=bool)

    def grid(self, gap: float) -> list[list[Array]]:
        """Unknowns (u,) to begin with, a list for each half gap: `gap` is an expected one at the load, 0: none."""
        halves = [share * self.range for share in _HALVES] + ([gap] if gap > 0.0 else [])
        tables = [self.places(half) for half in halves]
        if self.model.speed > 0.0:
            return tables
        # Without dynamics the load is on a flank wherever the motor turns, and a delay shows least there.
        speed = np.abs(np.gradient(self.drive))
        slow, first = self.lead[speed <= _SLOW * speed.max()], self.first()
        return [*tables, [self.model.start(0.5 * float(np.ptp(slow)), -0.5 * float(slow.max() + slow.min()), first)]]

    def places(self, half: float) -> list[Array]:
        """Unknowns (u,) to begin with at a half gap, in different places of the load in it."""
        first, middle = self.first(), -0.5 * float(self.lead.max() + self.lead.min())
        return [self.model.start(half, middle + place * self.range, first) for place in _PLACES]

    def beside(self, values: Array) -> list[Array]:
        """Unknowns (u,) to begin with where another window had `values` (u,)."""
        start = self.model.start(float(values[HALF]), float(values[OFFSET]), self._first_of_few())
        return [np.where([unknown.first for unknown in self.model.unknowns], start, values)]

    def _first_of_few(self) -> tuple[float, float]:
        """`first` by as few samples as are on a line: a load may be hit soon after the window's begin."""
        if self.model.speed == 0.0:
            return self.first()
        noise = _ON_A_LINE * max(noise_of(self.position), self.count)
        size = max(_FEWEST, round(_MOVED * self.position.size))
        while True:
            time, seen = self.interval * np.arange(size), self.position[:size]
            slope, value = np.polyfit(time, seen, 1)
            if size == _FEWEST or float(np.std(seen - slope * time - value)) <= noise:
                return float(value), float(slope)
            size = max(_FEWEST, size // 2)

    def on_one_flank(self, values: Array) -> list[list[Array]]:
        """Unknowns (u,) of a gap whose other flank is out of reach, lists for each flank, the lower one first.

        One list has the numbers of `values` and one the model's own: a fit with two flanks may have bent its numbers
        and its first state until they explain the window. In both the flank is also where `values` have it.
        """
        wide, middle = _WIDE * self.range, -0.5 * float(self.lead.max() + self.lead.min())
        first, tables = self._first_of_few(), []
        for side in (-1.0, 1.0):
            flanks = [middle + place * self.range for place in _PLACES]
            flanks.append(float(values[OFFSET] - side * values[HALF]))
            own = [self.model.start(wide, flank + side * wide, first) for flank in flanks]
            tried = [values.copy() for _ in flanks]
            for each, start in zip(tried, own, strict=True):
                each[[HALF, OFFSET]] = start[[HALF, OFFSET]]
            tables += [tried, own]
        return tables


def delayed(drive: Array, samples: float) -> Array:
    """A signal (N,) that is late by a number of samples, by cubics through four neighbours; its ends last."""
    if samples == 0.0:
        return drive
    out = np.empty(drive.size)
    delay(np.ascontiguousarray(drive), samples, out)
    return out


@bare
def delay(drive: Array, samples: float, out: Array) -> None:
    """`delayed` into `out` (N,)."""
    last = drive.size - 1
    for i in range(drive.size):
        at = i - samples
        whole = int(np.floor(at))
        t = at - whole
        a, b = drive[min(max(whole - 1, 0), last)], drive[min(max(whole, 0), last)]
        c, d = drive[min(max(whole + 1, 0), last)], drive[min(max(whole + 2, 0), last)]
        out[i] = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
