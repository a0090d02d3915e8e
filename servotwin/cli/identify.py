"""`servotwin identify`: the gap from a recorded log, window by window, and its trend."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.cli.gap_options import GapForm, stated_gap
from servotwin.cli.identify_windows import Followed, Report, followed
from servotwin.cli.log_controller import controller_remarks
from servotwin.errors import InvalidInput
from servotwin.estimation import motor_side
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.gap import default_method, settings_of
from servotwin.estimation.late_window import samples_late
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.motors_position import is_motors_position
from servotwin.estimation.passage import Passage
from servotwin.estimation.whitened.estimator import SHORTEST
from servotwin.estimation.window import Window
from servotwin.logs.log import Log, read_log
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.plant.plants import Plant, plant_of, resolve_plant
from servotwin.plant.scales import scales
from servotwin.plant.sensors import LOAD
from servotwin.twin.settings import TwinSettings

WINDOW = 1.0  # s of the servo's own
_WEAR = 40.0  # windows in which the gap of an axis grows by itself, where the log is shorter
_FREE = 8.0  # windows: a load behind a free shaft needs so much longer to come to rest


def _silent(_done: int, _total: int) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of the command; times in s, angles in deg. None: the value of the log, or the default.

    `at_load` has wear and limit that were given at the load, by key.
    """

    log: Path
    servo: str | None = None
    start: float | None = None
    duration: float | None = None
    window: float | None = None
    pre_trigger: float | None = None
    method: str = "whitened"
    wear_deg: float | None = None
    wear_over_s: float | None = None
    gap_limit_deg: float | None = None
    at_load: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Identification:
    """Gaps of a log's windows and their trend.

    Attributes
    ----------
    servo : Servo or Axis
        The model.
    windows : tuple of Window
    estimates : tuple of GapEstimate
        One for each window.
    remarks : tuple of tuple of str
        For each window, sentences on what it shows of the machine: a gap that has jumped or fallen, another machine,
        another controller.
    trend : Trend or None
        After the last window; None without an estimate that is OK.
    until_limit : Passage or None
        From `trend.time` on.
    """

    servo: Plant
    windows: tuple[Window, ...]
    estimates: tuple[GapEstimate, ...]
    remarks: tuple[tuple[str, ...], ...]
    trend: Trend | None
    until_limit: Passage | None


def identify(options: IdentifyOptions, progress: Report = _silent) -> Identification:
    """Read a log, cut windows, estimate their gaps and follow the trend.

    Parameters
    ----------
    options : IdentifyOptions
    progress : callable
        Called with the number of estimated windows and that of all, from the start again where the wear is not known.

    Raises
    ------
    InvalidInput
        The log, the servo or an option is not valid, or no window fits into the log.
    """
    log = read_log(options.log)
    servo = _servo(options, log)
    seen = _with_seen_load(servo, log.whole)
    stated = _settings(options, servo, _known_of_gap(seen))
    settings, windows = stated.on(servo), cut(log, options, servo)
    if isinstance(servo, Axis) and options.wear_over_s is None:
        found = _followed_without_wear(log, windows, seen, settings, progress)
    else:
        found = followed(windows, seen, settings, progress)
    trend = found.trend
    if seen is servo and not servo.at_motor:
        added = controller_remarks(windows, servo.controller)
        remarks = tuple(mine + more for mine, more in zip(found.remarks, added, strict=True))
        found = found._replace(remarks=remarks)
    until = None if settings.gap_limit is None or trend is None else trend.time_until(settings.gap_limit)
    return Identification(servo, windows, *found, until)


def _followed_without_wear(
    log: Log, windows: Sequence[Window], seen: Plant, settings: TwinSettings, progress: Report
) -> Followed:
    """The same of an axis of which nobody states the wear: it grows by what the log shows, and by itself in 40 windows.

    The wear decides which windows are accepted, and these show the wear: they are estimated again until both agree.
    """
    over, growth, known = log.whole.duration, 0.0, _known_of_gap(seen)
    share = min(1.0, over / (_WEAR * windows[0].duration))
    trend = TrendSettings(rate_std_rad_per_s=0.0, rate_walk_rad_per_s_per_sqrt_s=0.0, **known)
    while True:
        found = followed(windows, seen, replace(settings, trend=trend), progress)
        shown = _growth([estimate for estimate in found.estimates if estimate.ok], share)
        if shown <= 2.0 * growth:
            return found
        growth = shown
        trend = TrendSettings.for_wear(growth, over, **known)


def _known_of_gap(seen: Plant) -> dict[str, Any]:
    """Trend settings for the gap before its windows and the error that they share: no angle of another machine.

    Empty where the estimator itself counts its error as an angle, as that of a servo does.
    """
    method = motor_side.METHOD if seen.at_motor else default_method(seen)
    share = getattr(settings_of(method), "model_share", None)
    if share is None:
        return {}
    return {"gap_std_rad": seen.largest_gap, "shared_error_rad": 0.0, "shared_error_share": share}


def _growth(estimates: Sequence[GapEstimate], share: float) -> float:
    """Growth of the gap between estimates, at least a share of what it may be, rad; 0 without any."""
    gaps = [float(estimate.gap) for estimate in estimates]
    widest = max((float(estimate.interval[1]) for estimate in estimates), default=0.0)
    return max(share * widest, max(gaps) - min(gaps)) if gaps else 0.0


def cut(log: Log, options: IdentifyOptions, servo: Plant) -> tuple[Window, ...]:
    """Cut the window that the options name, or one after each change of the reference, as an edge does: no overlaps."""
    whole = log.whole
    if options.start is not None or options.duration is not None:
        if options.window is not None or options.pre_trigger is not None:
            raise InvalidInput(
                "--window and --pre-trigger cut at the steps: leave them out with --start and --duration"
            )
        return (_one(whole, options),)
    if whole.reference is None:
        raise InvalidInput(
            f"{whole.where}there is no column 'reference_{position_unit(servo).si}' to find the steps in: "
            "give --start and --duration"
        )
    length = _option("window", options.window, log.metadata.get("window_s"), _usual_window(servo, whole.sample_rate))
    before = _option("pre-trigger", options.pre_trigger, log.metadata.get("pre_trigger_s"), 0.0)
    if not 0.0 <= before < length:
        raise InvalidInput(f"--pre-trigger {before!r} s: must be at least 0 and below the window's {length!r} s")
    firsts = window_starts(whole.reference, round(length * whole.sample_rate), round(before * whole.sample_rate))
    if not firsts:
        shown = f"no change of the reference is followed by {length:g} s"
        raise InvalidInput(f"{whole.where}{shown}; give --start and --duration")
    return tuple(whole.slice(whole.start + first / whole.sample_rate, length) for first in firsts)


def _usual_window(servo: Plant, rate: float) -> float:
    """Length of windows where neither command nor log states one, s; of an axis enough samples at a rate (Hz)."""
    usual = WINDOW * scales(servo).time * (_FREE if servo.backlash_kind is BacklashKind.FREE else 1.0)
    return max(usual, (SHORTEST + samples_late(servo, rate)) / rate) if isinstance(servo, Axis) else usual


def window_starts(reference: Sequence[float] | np.ndarray[Any, Any], length: int, before: int) -> list[int]:
    """List the first samples of the windows that changes of the reference open, a start away from 0 included."""
    steps = np.flatnonzero(np.diff(np.asarray(reference), prepend=0.0))
    firsts: list[int] = []
    for step in steps:
        first = max(0, int(step) - before)
        if first + length <= len(reference) and not (firsts and step < firsts[-1] + length):
            firsts.append(first)
    return firsts


def _one(whole: Window, options: IdentifyOptions) -> Window:
    start = whole.start if options.start is None else options.start
    end = float(whole.start + whole.samples / whole.sample_rate)
    duration = end - start if options.duration is None else options.duration
    if not (math.isfinite(start) and math.isfinite(duration) and duration > 0.0):
        given = {"--start": options.start, "--duration": options.duration}
        shown = ", ".join(f"{name} {value!r} s" for name, value in given.items() if value is not None)
        raise InvalidInput(f"{whole.where}{shown}: the log goes from {whole.start:g} s to {end:g} s")
    return whole.slice(start, duration)


def _option(name: str, given: float | None, logged: Any, default: float) -> float:
    """Choose the given value, else the log's, else the default."""
    value = given if given is not None else (logged if isinstance(logged, int | float) else default)
    if not (math.isfinite(value) and value >= 0.0):
        raise InvalidInput(f"--{name} {value!r} s: must be a finite number of at least 0")
    return float(value)


def _servo(options: IdentifyOptions, log: Log) -> Plant:
    text = log.metadata.get("servo")
    if options.servo is not None:
        servo = resolve_plant(options.servo)
    elif isinstance(text, str):
        servo = plant_of(text, f"log {options.log}, servo")
    else:
        raise InvalidInput(f"{log.whole.where}the log does not describe its servo: give --servo, a preset or a TOML")
    position = position_unit(servo).si
    for channel, unit in (("position", position), ("reference", position), ("voltage", command_unit(servo))):
        if channel in log.names and log.unit(channel) != unit:
            raise InvalidInput(
                f"{log.whole.where}column {log.names[channel]!r} is in {log.unit(channel)}, and the machine counts it "
                f"in {unit}: give the log's own machine with --servo"
            )
    return servo


def _with_seen_load(servo: Plant, whole: Window) -> Plant:
    """The axis as its log shows it: one whose controller reads the motor may have an encoder at the load too."""
    if not isinstance(servo, Axis) or not servo.at_motor or not whole.has_position:
        return servo
    if is_motors_position(whole, servo):
        return servo
    return servo.replace(sensors=replace(servo.sensors, feedback=LOAD))


def _settings(options: IdentifyOptions, servo: Plant, known: Mapping[str, float]) -> TwinSettings:
    machine = options.servo or str(options.log)
    form, wear = stated_gap("wear", options.wear_deg, options.at_load, machine, servo)
    over = options.wear_over_s
    if (wear is None) != (over is None):
        raise InvalidInput(f"{form.option} and --wear-over-s belong together: give both, or neither")
    trend = TrendSettings()
    if wear is not None and over is not None:
        trend = TrendSettings.for_wear(form.at_motor(wear), over, **known)
    form, limit = stated_limit(options, servo)
    if limit is not None and not (math.isfinite(limit) and limit >= 0.0):
        raise InvalidInput(f"{form.option} {limit!r}: must be a finite number of at least 0")
    return TwinSettings(method=options.method, trend=trend, gap_limit=None if limit is None else form.at_motor(limit))


def stated_limit(options: IdentifyOptions, servo: Plant) -> tuple[GapForm, float | None]:
    """Largest acceptable gap, as it was given."""
    machine = options.servo or str(options.log)
    return stated_gap("gap_limit", options.gap_limit_deg, options.at_load, machine, servo)
