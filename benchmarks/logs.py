"""Gaps from foreign logs of every preset: all formats, all defects, cyclic errors and friction that no model knows.

``python -m benchmarks.batch logs --seed 5 --count 25 FILE`` measures; the blocks are the presets. A log shows the lost
motion: the gap, and the way by which the friction of the load winds up the transmission at a reversal. Both are
compared with the interval.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.batch import Batch
from benchmarks.log_files import WRITERS, damaged
from benchmarks.preset_machines import DUTIES
from servotwin.control.cascade import Cascade
from servotwin.errors import InvalidInput
from servotwin.estimation.driven_load.answer import gap_of_recording
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.wind_up import TransmissionGap, wind_up
from servotwin.logs.recordings import read_recording
from servotwin.plant.axis import Axis
from servotwin.plant.display_units import position_unit
from servotwin.plant.signals import Array, PiecewiseCubic
from servotwin.simulation import simulate

NAME = "logs"
_ERRORS = {"k": 0.05, "c": 0.3, "k_T": 0.1, "k_B": 0.1}
_STEP = 65.0  # healthy gaps that a preset moves in half a period of its duty
_SAMPLES, _LOGGED = 1_000_000, 30_000  # at most
_TURN = 2.0 * math.pi
_RAMP = 1.5  # peak speed of a stroke over its mean


@dataclass(frozen=True)
class LogCase:
    """One machine and its log.

    Attributes
    ----------
    name : str
        Of the preset.
    plant : Axis
    gap : float
        rad at the motor, total.
    amplitude : float
        m or rad of the load.
    speed : float
        Of the load, peak, m/s or rad/s.
    cyclic, period : float
        Amplitude at the load, and period in rad of the motor.
    file : str
        Key of `WRITERS`.
    seed : tuple of int
    """

    name: str
    plant: Axis
    gap: float
    amplitude: float
    speed: float
    cyclic: float
    period: float
    file: str
    seed: tuple[int, ...]

    @property
    def wind_up(self) -> float:
        """Way of the motor by which the load's friction winds up the transmission between two directions, rad."""
        return wind_up(self.plant)

    def reference(self) -> tuple[PiecewiseCubic, float]:
        """Strokes to and fro of various lengths and speeds, and their duration in s."""
        random = np.random.default_rng([*self.seed, 1])
        turns = int(random.integers(12, 24))
        sides = np.where(np.arange(turns) % 2, -1.0, 1.0)
        points = np.concatenate([[0.0], self.amplitude * sides * random.uniform(0.5, 1.0, turns)])
        speeds = self.speed * np.where(random.random(turns) < 0.5, 1.0, 0.5)
        spans = _RAMP * np.abs(np.diff(points)) / speeds
        times = np.concatenate([[0.0], np.cumsum(spans)])
        slopes = np.diff(points) / spans**2
        coeffs = np.column_stack([points[:-1], 0.0 * spans, 3.0 * slopes, -2.0 * slopes / spans])
        last = [points[-1], 0.0, 0.0, 0.0]
        return PiecewiseCubic(times, np.vstack([coeffs, last])), float(times[-1])

    def recorded(self) -> Array:
        """(n, 3) times in s, motor angles in rad and load positions in m or rad, as the encoders count them."""
        reference, duration = self.reference()
        rate = self.plant.controller.sample_rate
        assert rate is not None
        samples = min(max(2, math.floor(duration * rate)), 2 * _SAMPLES)
        run = simulate(self.plant, samples / rate, reference=reference, gap=self.gap, sample_rate=rate)
        every = max(1, samples // _LOGGED)
        random = np.random.default_rng([*self.seed, 2])
        motor, screw = run.theta_m[::every], run.theta_d[::every]
        load = run.position[::every] + self.cyclic * np.sin(_TURN / self.period * screw + random.uniform(0.0, _TURN))
        sensors = self.plant.sensors
        late = random.uniform(0.0, 1.0) / rate
        load = np.interp(run.time[::every] - late, run.time[::every], load)
        return np.column_stack(
            [
                run.time[::every],
                _counted(motor, sensors.encoder_resolution),
                _counted(load + random.uniform(-1.0, 1.0), sensors.position_resolution),
            ]
        )


def _counted(values: Array, count: float) -> Array:
    return np.round(values / count) * count if count else values


def log_cases(name: str, count: int, seed: int) -> list[LogCase]:
    """Draw machines of a preset: gaps from two counts to a turn of the motor, slow motions and fast ones."""
    place = list(DUTIES).index(name)
    return [_drawn(name, (seed, place, index)) for index in range(count)]


def _drawn(name: str, seed: tuple[int, ...]) -> LogCase:
    random, model, duty = np.random.default_rng([*seed, 0]), Axis.preset(name), DUTIES[name]
    plant = model.scaled({each: 1.0 + width * random.uniform(-1.0, 1.0) for each, width in _ERRORS.items()})
    if random.random() < 0.5:
        law = plant.controller
        on_motor = replace(law, on="motor") if isinstance(law, Cascade) else law
        plant = plant.replace(sensors=replace(plant.sensors, feedback="motor"), controller=on_motor)
    healthy = duty.gap / model.p
    count = max(model.sensors.encoder_resolution, model.sensors.position_resolution / model.p)
    kind = random.random()
    gap = healthy * 10.0 ** random.uniform(0.0, 1.0)
    if kind < 0.15:
        gap = 2.0 * count
    elif kind < 0.25:
        gap = _TURN
    amplitude = max(gap * random.uniform(3.0, 30.0) if gap < _TURN else gap * random.uniform(2.0, 4.0), 30.0 * healthy)
    amplitude *= model.p
    speed = _STEP * duty.gap / duty.half_period * 10.0 ** random.uniform(-1.5, 0.0)
    # Slow strokes over a long way: as fast as a million samples allow.
    rate = model.controller.sample_rate
    assert rate is not None
    speed = max(speed, 40.0 * amplitude * rate / _SAMPLES)
    cyclic = gap * model.p * 10.0 ** random.uniform(-2.0, -0.7)
    period = _TURN * random.choice([1.0, 0.5, 0.137]) if amplitude > 20.0 * model.p else amplitude / model.p / 7.3
    return LogCase(name, plant, gap, amplitude, speed, cyclic, period, str(random.choice(list(WRITERS))), seed)


class _Answered(NamedTuple):
    """Answers to one log: without a machine and with it, and its recording in SI units at the load."""

    recording: EncoderRecording
    alone: TransmissionGap
    with_axis: TransmissionGap | str


def _answered(case: LogCase, path: Path, table: Array) -> _Answered:
    """Write a log, read it and estimate its gap; a refusal of the axis is its sentence."""
    recording = read_recording(path, WRITERS[case.file](path, table)).recording
    lost = estimate_lost_motion(recording)
    in_si = replace(recording, load_unit=position_unit(case.plant).si)
    machine = Axis.preset(case.name)
    try:
        known: TransmissionGap | str = gap_of_recording(in_si, lost, machine)
    except InvalidInput as error:
        known = str(error).partition(": ")[2]
    return _Answered(in_si, gap_of_recording(in_si, lost), known)


def measured(case: LogCase) -> dict[str, Any]:
    """Write a case's log, read it and estimate its gap as `servotwin identify` does."""
    table, defects = damaged(case.recorded(), np.random.default_rng([*case.seed, 3]), wrapped=True)
    found: dict[str, Any] = {
        "gap": case.gap, "lost": case.gap + case.wind_up, "speed": case.speed, "file": case.file, "defects": defects,
        "gap_load": case.gap * case.plant.p,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        try:
            answered = _answered(case, Path(folder) / case.file, table)
        except InvalidInput as error:
            return found | {"status": "refused", "reasons": [str(error).partition(": ")[2]]}
    answer, lost = answered.alone, answered.alone.lost
    known = answered.with_axis
    of_axis = {"status": "refused", "reasons": [known]} if isinstance(known, str) else _said(known)
    return found | {
        "axis": of_axis,
        "ratio": lost.ratio / case.plant.p,
        "status": answer.status.value,
        "reasons": list(answer.reasons),
        "model": lost.model,
        "lost_motion": lost.at_motor if math.isfinite(lost.at_motor) else None,
        "lost_motion_interval": _numbers(lost.interval_motor),
        "interval": _numbers(answer.interval_motor),
        "interval_load": _numbers(answer.interval_load),
    }


def _said(found: TransmissionGap) -> dict[str, Any]:
    return {
        "status": found.status.value,
        "interval": _numbers(found.interval_motor),
        "interval_load": _numbers(found.interval_load),
        "ratio_found": found.lost.ratio,
        "reasons": list(found.reasons),
        "model": found.lost.model,
    }


def _numbers(interval: tuple[float, float]) -> list[float | None]:
    return [end if math.isfinite(end) else None for end in interval]


def _units(names: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, LogCase]]:
    """Cases of all presets by turns."""
    drawn = {name: log_cases(name, count, seed) for name in names}
    for place in range(count):
        yield from ((f"{seed}/{name}/{place}", cases[place]) for name, cases in drawn.items())


def inside(interval: Sequence[float | None], first: float, last: float | None = None) -> bool:
    """True where the interval contains a gap, or some gap from `first` to `last`."""
    low, high = interval
    last = first if last is None else last
    return (low is None or low <= last) and (high is None or first <= high)


def _show(found: Mapping[str, Any], console: Console) -> None:
    result = Table(title="logs: gaps of two encoders", title_justify="left", box=None)
    result.add_column("preset")
    for heading in (
        *("logs", "lost\nmotion", "in its\ninterval", "or gap to\nlost motion", "gap in\ninterval"),
        *(
            "doubtful",
            "lost\nmotion in",
            "gap in",
            "refused",
            "ok without\nan axis",
            "gap in",
            "with an\naxis",
            "gap in",
        ),
    ):
        result.add_column(heading, justify="right")
    for name in (*DUTIES, ""):
        rows = [numbers for key, numbers in found.items() if not name or key.split("/")[1] == name]
        if rows:
            result.add_row(name or "all", *map(str, _line(rows)))
    console.print(result)
    reasons: Counter[str] = Counter(
        f"{each['status']}: {reason[:60]}" for each in found.values() for reason in each["reasons"][:1]
    )
    for words, count in reasons.most_common(12):
        console.print(f"{count} x {words}", markup=False, highlight=False)


def _line(rows: Sequence[Mapping[str, Any]]) -> tuple[int, ...]:
    accepted = [each for each in rows if each["status"] == "lost motion"]
    known = [each for each in rows if each.get("axis", {}).get("status") == "ok"]
    fine = [each for each in rows if each["status"] == "ok"]
    doubtful = [each for each in rows if each["status"] not in ("ok", "lost motion", "refused")]
    return (
        len(rows),
        len(accepted),
        sum(inside(each["lost_motion_interval"], each["lost"]) for each in accepted),
        sum(inside(each["lost_motion_interval"], each["gap"], each["lost"]) for each in accepted),
        sum(inside(each["interval"], each["gap"]) for each in accepted),
        len(doubtful),
        sum(inside(each["lost_motion_interval"], each["lost"]) for each in doubtful),
        sum(inside(each["interval"], each["gap"]) for each in doubtful),
        sum(each["status"] == "refused" for each in rows),
        len(fine),
        sum(inside(each["interval"], each["gap"]) for each in fine),
        len(known),
        sum(inside(each["axis"]["interval"], each["gap"]) for each in known),
    )


BATCH = Batch(_units, measured, _show, tuple(DUTIES))
"""For `benchmarks.batch`."""
