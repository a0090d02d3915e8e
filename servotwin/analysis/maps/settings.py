"""Settings of a stability map: servo, controller, axes, initial states, durations."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from typing import Any

from servotwin.analysis.limit_cycles.scaled import characteristic_time
from servotwin.analysis.maps.axes import Axes, RatioAxes, as_lists, axis_names
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, Law, law_of
from servotwin.control.retuning import check_zone_acts
from servotwin.errors import InvalidInput
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales

# Raise it whenever the same settings would give other numbers: stored pieces then no longer match.
FORMAT = 1
# s, s, s and m on the preset `paper`, whose gap is 10 degrees.
_DURATION, _WINDOW, _SHORT_WINDOW, _STILL = 120.0, 40.0, 10.0, 1e-6
_GAP, _WIDE = math.radians(10.0), math.radians(5.0)
_STILL_STEP = 1e-3  # of the step, where there is no gap
MAX_SAMPLES = 200_000
# Samples of all members of a chunk: a quarter of a second's work, 16 MB of position and voltage.
_SAMPLES_PER_CHUNK = 1_000_000
# Samples per turn at the loop's crossover: a limit cycle's peak is missed by half a per cent at most.
_SAMPLES_PER_TURN = 32


@dataclass(frozen=True)
class MapSettings:
    """A stability map.

    Parameters
    ----------
    servo : Servo or Axis
    axes : RatioAxes or PhysicalAxes
    controller : Controller, Cascade or LinearLaw, optional
        Continuous; the servo's own by default.
    members : int
        Initial states in each cell. The first is at rest with the screw in the middle of the gap (the paper's); all
        others have the screw anywhere in the gap, and every second of those is in motion.
    motion : float
        Extent of that motion: uniform within this many step * crossover / p of motor speed and Ki * step / crossover
        of integral action, what an error of one step makes in one radian of the crossover; of other laws each state
        that the dead zone stops has what a reference of one step makes. 0: all start from rest.
    seed : int
        Of the initial states; each cell has a generator of its own.
    duration : float, optional
        s, of every run; 120 s of the servo's own (`plant.scales`) by default, see `run_time`.
    window : float, optional
        s, length of the last part of the run, from which the measures are taken; 40 s of the servo's own by default,
        see `last_part`. A loop with integral action may rest for more than ten seconds and move on, in cycles of 27 s.
    still : float, optional
        m; a run has settled when half the peak-to-peak of the position in the window is below this. By default 1 um on
        the preset `paper` with a gap of 10 degrees, and as much of another's screw and gap; see `stillness`.

    Raises
    ------
    InvalidInput
        A value is outside its range, the controller is sampled or does not stabilise the servo even without a gap.
    """

    servo: Plant
    axes: Axes
    controller: AnyController | None = None
    members: int = 16
    motion: float = 1.0
    seed: int = 0
    duration: float | None = None
    window: float | None = None
    still: float | None = None

    def __post_init__(self) -> None:
        self.axes.check_gap(self.servo)
        _check_law(self.law)
        if any(self.axes.tolerance if isinstance(self.axes, RatioAxes) else self.axes.k_dz):
            check_zone_acts(self.servo.controller if self.controller is None else self.controller, "map: the dead zone")
        self.servo.check_loop(self.law)
        for name, least in (("members", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InvalidInput(f"map {name} = {value!r}: must be an integer of {least} or more")
        for name, unit in (("duration", "s"), ("window", "s"), ("still", "m")):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"map {name} = {value!r} {unit}: must be finite and greater than 0")
        if not (math.isfinite(self.motion) and self.motion >= 0.0):
            raise InvalidInput(f"map motion = {self.motion!r}: must be finite and 0 or more")
        if self.last_part > self.run_time:
            raise InvalidInput(f"map window = {self.last_part:g} s: must be at most the duration, {self.run_time:g} s")
        if self.samples > MAX_SAMPLES:
            raise InvalidInput(
                f"map duration = {self.run_time:g} s: gives {self.samples} samples of this loop, at"
                f" {self.sample_rate:g} Hz; at most {MAX_SAMPLES} are allowed"
            )

    @property
    def law(self) -> Law:
        """The law that runs."""
        return law_of(self.servo.controller if self.controller is None else self.controller)

    @property
    def run_time(self) -> float:
        """Duration of every run, s."""
        return _DURATION * self._second if self.duration is None else self.duration

    @property
    def last_part(self) -> float:
        """Length of the last part of a run, in which it must rest, s."""
        return _WINDOW * self._second if self.window is None else self.window

    @property
    def short_part(self) -> float:
        """Length of a last part that would be too short, s."""
        return _SHORT_WINDOW * self._second

    @property
    def stillness(self) -> float:
        """Half the peak-to-peak below which a position rests, m."""
        if self.still is not None:
            return self.still
        unit = _STILL * scales(self.servo).length
        if isinstance(self.axes, RatioAxes):
            return unit * (self.axes.gap / _GAP)
        widest = max(self.axes.gap)
        return unit * min(1.0, widest / _WIDE) if widest > 0.0 else _STILL_STEP * min(self.axes.amplitude)

    @property
    def _second(self) -> float:
        return scales(self.servo).time

    @property
    def count(self) -> int:
        """Number of cells."""
        return math.prod(self.axes.shape)

    @property
    def sample_rate(self) -> float:
        """Rate of the samples that the measures are taken from, Hz; the location of events does not depend on it."""
        second = self._second
        return math.ceil(_SAMPLES_PER_TURN * second / characteristic_time(self.servo, self.law)) / second

    @property
    def samples(self) -> int:
        """Number of samples of a run, both ends included."""
        return round(self.run_time * self.sample_rate) + 1

    @property
    def chunks(self) -> tuple[range, ...]:
        """Cells in pieces; each piece is computed and stored as one."""
        size = max(1, _SAMPLES_PER_CHUNK // (self.members * self.samples))
        return tuple(range(first, min(first + size, self.count)) for first in range(0, self.count, size))

    def described(self) -> dict[str, Any]:
        """Everything that the numbers depend on, as plain values with their units in the keys."""
        return {
            "format": FORMAT,
            "servo": self.servo.dumps(),
            "controller": asdict(self.law),
            "axes": list(axis_names(self.axes)),
            **{f"axis_{name}": values for name, values in as_lists(self.axes).items()},
            "members": self.members,
            "motion": self.motion,
            "seed": self.seed,
            "duration_s": self.run_time,
            "window_s": self.last_part,
            "still_m": self.stillness,
        }

    @property
    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that name these settings."""
        return hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:16]


def _check_law(law: Law) -> None:
    for name in ("sample_rate", "rate_limit"):
        if getattr(law, name) is not None:
            value = getattr(law, name)
            raise InvalidInput(
                f"controller {name} = {value:g}: maps are those of the continuous law; give {name} = None"
            )
    if isinstance(law, Controller) and law.friction_feedforward:
        raise InvalidInput(
            f"controller friction_feedforward = {law.friction_feedforward:g} V: maps do not simulate it; give 0"
        )
