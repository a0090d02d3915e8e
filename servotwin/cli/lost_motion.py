"""`servotwin identify` without a model: the gap between the two encoders of a recording."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from servotwin.cli.log_dates import DATED, LogDate, date_of, dates_of, iso
from servotwin.errors import InvalidInput
from servotwin.estimation.driven_load.answer import gap_of_recording
from servotwin.estimation.estimate import NORMAL_95, NOTHING_KNOWN, Interval
from servotwin.estimation.kinematic.growth import LEAST, GapGrowth, growth
from servotwin.estimation.kinematic.lost_motion import LostMotion, estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.travel import StatedTravel, in_stated_unit
from servotwin.estimation.kinematic.wind_up import TransmissionGap
from servotwin.logs.recordings import RecordedLog, RecordingColumns, read_recording
from servotwin.plant.display_units import DEGREES, MILLIMETRES
from servotwin.plant.plants import Plant, resolve_plant

_Answer = tuple[RecordedLog, TransmissionGap]
_PLACES = 5  # parts of the travel, and of the time, in the table of local gaps


def show(
    logs: Sequence[Path],
    columns: RecordingColumns,
    as_json: bool,
    page: Path | None = None,
    axis: str | None = None,
    dates: str | None = None,
    stiff: bool = False,
    dynamics: bool = False,
    travel: StatedTravel | None = None,
) -> None:
    """Estimate each log's gap and print it; with several, their differences too; draw the last one's page.

    The load's frequency, damping and friction are fitted beside the gap where play alone shows that it swings, and
    with `dynamics` in any log whose gap is not known.

    Raises
    ------
    InvalidInput
        As `read_recording` and `estimate_lost_motion`; or both a machine and a stiff one are given.
    """
    if stiff and dynamics:
        raise InvalidInput("--stiff and --dynamics: give one of the two; a load behind a stiff transmission has none")
    if stiff and axis is not None:
        raise InvalidInput(f"--stiff and --axis {axis}: give one of the two; the axis says how stiff it is")
    console = Console(stderr=as_json)
    if page is not None:
        from servotwin.cli.lost_motion_page import write_page
        from servotwin.report.panels import check_page

        check_page(page)
    machine = None if axis is None else resolve_plant(axis)
    given = dates_of(dates, len(logs))
    answers = []
    asked = partial(
        _answered,
        columns=columns,
        machine=machine,
        stiff=stiff,
        dynamics=dynamics,
        travel=travel,
        read_by_people=not as_json,
    )
    for path in logs:
        with console.status(path.name) as status:
            answers.append(asked(path, partial(_tell, status, path.name)))
    if page is not None:
        log, found = answers[-1]
        said = Text.from_markup(headline(found, log.recording.load_unit, log.recording.motor_unit)).plain
        write_page(page, log, found, said)
    _check_units(answers)
    stamps = [date_of(log, day) for (log, _), day in zip(answers, given, strict=True)]
    wear = _wear(answers, stamps)
    if as_json:
        _print_json(answers, stamps, wear)
        return
    for log, found in answers:
        _print(console, log, found)
    for before, after in pairwise(answers):
        console.print(_change(before, after), highlight=False)
    if wear:
        console.print(_said(wear, answers[-1][0].recording.load_unit), highlight=False)


def _answered(
    path: Path,
    tell: Callable[[str], object],
    *,
    columns: RecordingColumns,
    machine: Plant | None,
    stiff: bool,
    dynamics: bool,
    travel: StatedTravel | None,
    read_by_people: bool,
) -> _Answer:
    """Read a log and estimate its gap, in units for people or in the log's own."""
    log = read_recording(path, columns, partial(_tell_samples, tell))
    if read_by_people:
        log = replace(log, recording=_in_shown_units(log.recording))
    tell("models")
    recording, lost = log.recording, estimate_lost_motion(log.recording)
    if travel is not None:
        recording, lost = in_stated_unit(recording, lost, travel)
        log = replace(log, recording=recording)
    return log, gap_of_recording(recording, lost, machine, stiff=stiff, dynamics=dynamics, tell=tell)


def _in_shown_units(recording: EncoderRecording) -> EncoderRecording:
    """The recording with metres in mm, and both ends of a rotary axis in degrees."""
    shown = {"m": MILLIMETRES, "rad": DEGREES} if recording.load_unit == "rad" else {"m": MILLIMETRES}
    for end in ("motor", "load"):
        unit = shown.get(getattr(recording, f"{end}_unit"))
        if unit is None:
            continue
        count = getattr(recording, f"{end}_count")
        recording = replace(
            recording,
            **{
                end: unit.factor * getattr(recording, end),
                f"{end}_unit": unit.name,
                f"{end}_count": None if count is None else unit.factor * count,
            },
        )
    return recording


class _Wear(NamedTuple):
    """Growth of a quantity over so many logs, from one date to another."""

    growth: GapGrowth
    quantity: str
    logs: int
    begin: float
    end: float


def _check_units(answers: Sequence[_Answer]) -> None:
    first = answers[0][0].recording
    for log, _ in answers[1:]:
        if log.recording.load_unit != first.load_unit:
            raise InvalidInput(
                f"{log.recording.source}: its load is in {log.recording.load_unit}, that of {first.source} in "
                f"{first.load_unit}: give --load-unit"
            )


def _wear(answers: Sequence[_Answer], stamps: Sequence[LogDate]) -> _Wear | str:
    """Growth over the logs whose gap, or lost motion, is known; or the reason against, empty for one log or two."""
    if len(answers) < LEAST:
        return ""
    if any(stamp.origin == "file" for stamp in stamps):
        return "the dates of files are not those of recordings; give --dates"
    quantity = _compared(answers)
    known = [place for place, (_, found) in enumerate(answers) if found.ok or found.lost.ok]
    dates = [stamps[place].time for place in known]
    values = [_value(answers[place][1], quantity) for place in known]
    grown = growth(dates, [value for value, _ in values], [_half(interval) / NORMAL_95 for _, interval in values])
    if grown is None:
        return f"the {quantity} is known in {len(known)} of {len(answers)} logs; three of different dates are needed"
    longest = max(float(np.ptp(log.recording.time)) for log, _ in answers)
    if max(dates) - min(dates) <= longest:
        return f"the dates lie within {max(dates) - min(dates):.4g} s, and one log alone lasts {longest:.4g} s"
    return _Wear(grown, quantity, len(known), min(dates), max(dates))


def _compared(answers: Sequence[_Answer]) -> str:
    """Name of the quantity that all logs show: the gap, or else the lost motion."""
    return "gap" if all(found.ok for _, found in answers) else "lost motion"


def _value(found: TransmissionGap, name: str) -> tuple[float, Interval]:
    """Gap or lost motion at the load, and its 95 % interval."""
    lost = found.lost
    return (found.gap_load, found.interval_load) if name == "gap" else (lost.at_load, lost.interval_load)


def _said(wear: _Wear | str, unit: str) -> str:
    if isinstance(wear, str):
        return f"no growth per year: {wear}"
    low, high = wear.growth.interval
    return (
        f"wear from {iso(wear.begin)[:10]} to {iso(wear.end)[:10]}: {wear.quantity} {wear.growth.per_year:+.4g} "
        f"{unit} per year (95 %: {low:+.4g} .. {high:+.4g}), in {wear.logs} logs"
    )


def _tell_samples(tell: Callable[[str], object], samples: int) -> None:
    tell(f"{samples:,} samples read")


def _tell(status: Any, name: str, what: str) -> None:
    status.update(f"{name}: {what}")


def _print_json(answers: Sequence[_Answer], stamps: Sequence[LogDate], wear: _Wear | str) -> None:
    rows = [
        as_dict(log, found) | {"date": iso(stamp.time), "date_from": stamp.origin}
        for (log, found), stamp in zip(answers, stamps, strict=True)
    ]
    if isinstance(wear, _Wear):
        rows[-1] |= {
            "growth_of": wear.quantity,
            "growth_logs": wear.logs,
            "growth_per_year_load": wear.growth.per_year,
            "growth_interval_load": list(wear.growth.interval),
        }
    print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2, allow_nan=False))


def as_dict(log: RecordedLog, found: TransmissionGap) -> dict[str, Any]:
    """Make the JSON object: gaps in the units of the recording, null where there is no number."""
    recording, lost = log.recording, found.lost
    return {
        "log": recording.source.removeprefix("log "),
        "status": found.status.value,
        "reasons": list(found.reasons),
        "model_kind": lost.model,
        "gap_load": _number(found.gap_load),
        "std_load": _number(found.std_load),
        "interval_load": [_number(end) for end in found.interval_load],
        "unit_load": recording.load_unit,
        "gap_motor": _number(found.gap_motor),
        "std_motor": _number(found.std_motor),
        "interval_motor": [_number(end) for end in found.interval_motor],
        "unit_motor": recording.motor_unit,
        "lost_motion_load": _number(lost.at_load),
        "lost_motion_interval_load": [_number(end) for end in lost.interval_load],
        "lost_motion_motor": _number(lost.at_motor),
        "lost_motion_interval_motor": [_number(end) for end in lost.interval_motor],
        "ratio": _number(lost.ratio),
        "lag_s": _number(lost.lag),
        "cyclic_periods_motor": list(lost.cycles),
        "rms_load": _number(lost.rms),
        "models": [
            {
                "model_kind": each.name,
                "lost_motion_motor": _number(each.gap),
                "rms_out_of_sample_load": _number(each.rms),
                "evidence": each.evidence,
            }
            for each in found.trials
        ],
        "segments": [
            {"time_s": each.time, "position_load": each.position, "lost_motion_motor": each.gap} for each in lost.local
        ],
        "samples": log.samples,
        "defects": dict(log.found),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _print(console: Console, log: RecordedLog, found: TransmissionGap) -> None:
    lost, recording, unit = found.lost, log.recording, log.recording.load_unit
    console.print(f"{recording.source.removeprefix('log ')}: {read_line(log)}", markup=False)
    for defect, count in log.found.items():
        console.print(f"  {defect}: {count}", style="dim", highlight=False)
    console.print(headline(found, unit, recording.motor_unit), highlight=False)
    for reason in found.reasons:
        console.print(f"  {reason}", style="yellow", highlight=False)
    if not lost.comparisons:
        return
    console.print(model_line(found, unit, recording.motor_unit), highlight=False)
    console.print(_models(found, unit), highlight=False)
    if len(lost.local) > 1:
        for table in _local(lost, unit, float(log.recording.time[0])):
            console.print(table, highlight=False)


def read_line(log: RecordedLog) -> str:
    """Say how many samples of which columns were used."""
    time = log.recording.time
    parts = ", ".join(f"{part}: {name}" for part, name in log.columns.items())
    return f"{time.size} samples in {time[-1] - time[0]:.4g} s ({parts})"


def model_line(found: TransmissionGap, unit: str, motor_unit: str) -> str:
    """Say which model was chosen, and its numbers."""
    lost = found.lost
    cyclic = "".join(f", cyclic error every {period:.4g} {motor_unit}" for period in lost.cycles)
    return (
        f"model: {lost.model}; {abs(lost.ratio):.6g} {unit} per {motor_unit}, lag {1e3 * lost.lag:.3g} ms"
        f"{cyclic if 'cyclic' in lost.model else ''}, residual {lost.rms:.3g} {unit} rms"
    )


def headline(found: TransmissionGap, unit: str, motor_unit: str) -> str:
    """Say in one line what is known, and its status, in the markup of rich."""
    lost, status = found.lost, f"[{'green' if found.ok else 'yellow'}]{found.status.value}[/]"
    if lost.interval_motor == NOTHING_KNOWN:
        return f"no gap is known; status: {status}"
    if math.isinf(lost.interval_motor[1]):
        return f"lost motion > {lost.at_motor:.4g} {motor_unit} at the motor; status: {status}"
    if math.isnan(found.gap_motor):
        (low, high), most = lost.interval_load, found.interval_load[1]
        return (
            f"lost motion {lost.at_load:.4g} {unit} at the load, {lost.at_motor:.4g} {motor_unit} at the motor "
            f"(95 %: {low:.4g} .. {high:.4g} {unit}); the gap is at most {most:.4g} {unit}; status: {status}"
        )
    low, high = found.interval_load
    return (
        f"gap {found.gap_load:.4g} {unit} at the load, {found.gap_motor:.4g} {motor_unit} at the motor "
        f"(95 %: {low:.4g} .. {high:.4g} {unit}); status: {status}"
    )


def _models(found: TransmissionGap, unit: str) -> Table:
    heads = "model", f"lost motion\n{unit}", f"error on unseen\nstrokes, {unit}", "evidence"
    table = Table(*heads, box=None, pad_edge=False)
    for row in model_rows(found):
        name = f"[bold]{row[0]}[/]" if row[0] == found.lost.model else row[0]
        table.add_row(name, *row[1:])
    return table


def model_rows(found: TransmissionGap) -> list[list[str]]:
    """Name, lost motion and error at the load, and evidence of each model that was tried."""
    scale = abs(found.lost.ratio)
    return [
        [each.name, *(f"{value:.4g}" if math.isfinite(value) else "-" for value in (each.gap * scale, each.rms)),
         each.evidence]
        for each in found.trials
    ]  # fmt: skip


def _local(found: LostMotion, unit: str, begin: float) -> Iterator[Table]:
    """Median lost motion of parts of the travel and of the time; dates count from the first sample, `begin` (s)."""
    gaps = np.array([each.gap for each in found.local]) * abs(found.ratio)
    first = begin if begin > DATED else 0.0
    positions, times = np.array([(each.position, each.time - first) for each in found.local]).T
    for head, keys in ((f"position, {unit}", positions), ("time, s", times)):
        table = Table(head, f"median lost motion, {unit}", "reversals", box=None, pad_edge=False)
        for row in _binned(keys, gaps):
            table.add_row(*row)
        yield table


def _binned(keys: Any, gaps: Any) -> list[tuple[str, str, str]]:
    edges = np.linspace(keys.min(), keys.max(), _PLACES + 1)
    place = np.clip(np.searchsorted(edges, keys, side="right") - 1, 0, _PLACES - 1)
    rows = []
    for i in range(_PLACES):
        here = gaps[place == i]
        middle = f"{np.median(here):.4g}" if here.size else "-"
        rows.append((f"{edges[i]:.4g} .. {edges[i + 1]:.4g}", middle, str(here.size)))
    return rows


def _change(before: _Answer, after: _Answer) -> str:
    """The difference of two logs' gaps, or lost motions, with half of its 95 % interval."""
    (_, old), (second, new) = before, after
    if not (math.isfinite(old.lost.std_load) and math.isfinite(new.lost.std_load)):
        return "no change can be told: the lost motion of the two logs is only bounded"
    name = _compared((before, after))
    (one, its), (other, of_it) = _value(old, name), _value(new, name)
    change, half = other - one, math.hypot(_half(its), _half(of_it))
    said = "more than chance explains" if abs(change) > half else "no more than chance explains"
    return f"change of the {name}: {change:+.4g} ± {half:.2g} {second.recording.load_unit} (95 %): {said}"


def _half(interval: Interval) -> float:
    low, high = interval
    return 0.5 * (high - low)
