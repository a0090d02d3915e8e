"""`servotwin bench triage`: missed changes, false alarms and time of glances."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.estimator_windows import WindowCase, paper_loop_cases
from benchmarks.wrong_models import ModelError
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.whitened.quick import QuickFit, quick_fit
from servotwin.messages import Channel, WindowMessage, checksum, decode, encode, pack_channel, pack_finely
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.twin.estimating import decode_window, estimator_of
from servotwin.twin.settings import TwinSettings
from servotwin.twin.triage import TriageState, glance

NAME, SCHEMA = "triage", "servotwin-bench-triage/1"
GAPS, QUICK = 160, 8
PER_GAP = 6
MOVED_DEG = (0.0, 0.1, 0.2, 0.3, 0.5)
KNOWN_DEG = 0.005
"""Spread of the gap before the glance."""
CONDITIONS = {"clean": None, "noise, floor 1 um": 1e-6, "noise, floor 10 um": 1e-5}
"""The paper's noise, on a white floor of so many m."""
ERROR, FLOOR = ModelError(0.05, 0.3, 0.01), 1e-6
LEARNT = {"1 um, machine off": 0, "..., 1 window learnt": 1, "..., 3 windows learnt": 3}
"""Machines off by up to 5 % (k), 30 % (c) and 1 % (pitch): windows of the same gap from which the twin has learnt."""
_UNITS = {"position": "m", "theta_m": "rad", "voltage": "V", "reference": "m"}


class Looked(NamedTuple):
    """A window with the model to glance at it with, and what was learnt of the machine."""

    case: WindowCase
    model: Servo
    machine: FactorPrior | None


class GlanceRow(NamedTuple):
    """One condition.

    Attributes
    ----------
    condition : str
    windows : int
    error, std : float
        deg: root mean square of the glances' errors, and the median of the spreads that they state.
    seen : tuple of float
        Share of windows that would be estimated, for each of `MOVED_DEG`.
    least, median : float
        ms from a window's bytes to the verdict.
    """

    condition: str
    windows: int
    error: float
    std: float
    seen: tuple[float, ...]
    least: float
    median: float


def triage(
    date: str = "", output: Path | None = None, gaps: int = GAPS, console: Console | None = None
) -> tuple[GlanceRow, ...]:
    """Glance at windows of the paper's loop whose gap has moved; print, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    gaps : int
        How many, from 1 to 40 deg; six windows of each.
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    rows = [
        _row(name, [Looked(case, case.servo, None) for case in _cases(floor, gaps)])
        for name, floor in CONDITIONS.items()
    ]
    rows += [_row(name, list(_off_model(gaps, learnt))) for name, learnt in LEARNT.items()]
    console.print(_table(rows), highlight=False)
    report.write(output, report.text(SCHEMA, date, rows=[row._asdict() for row in rows]), console)
    return tuple(rows)


def _row(name: str, looked: Sequence[Looked]) -> GlanceRow:
    fits = [quick_fit(each.case.window, each.model, each.case.gap, None, each.machine) for each in looked]
    errors = np.degrees([fit.gap - each.case.gap for fit, each in zip(fits, looked, strict=True)])
    usual = 1.5 * float(np.median([fit.misfit for fit in fits]))
    rng = np.random.default_rng(1)
    messages = [_message(each.case) for each in looked]
    shares = tuple(_estimated_share(looked, messages, moved, usual, rng) for moved in MOVED_DEG)
    times = [_glance_time(each, message, usual) for each, message in zip(looked, messages, strict=True)]
    error, std = float(np.sqrt(np.mean(errors**2))), math.degrees(float(np.median([_spread(fit) for fit in fits])))
    return GlanceRow(name, len(looked), error, std, shares, min(times), float(np.median(times)))


def _spread(fit: QuickFit) -> float:
    """rad, what is open of the machine included."""
    return math.hypot(fit.std, fit.machine_spread().gap)


def _off_model(gaps: int, learnt: int) -> Iterator[Looked]:
    """Windows of machines that differ from the model, after a twin has learnt from so many of the same gap."""
    rng, model, settings = np.random.default_rng(2), Servo.preset("paper"), TwinSettings()
    estimator = estimator_of(model, settings)
    for number, gap in enumerate(np.radians(rng.uniform(1.0, 40.0, gaps))):
        machine, wear, seen = ERROR.machine(rng, model), Wear(0.0), 0
        for case in paper_loop_cases(np.array([gap]), PER_GAP, 2026 + number, None, machine):
            noisy, now = case.noisy(FLOOR * rng.standard_normal(case.window.position.size)), case.window.mid_time
            if seen < learnt:
                expected = wear.expect(settings.trend, "b", now, now, settings.learning)
                estimate = estimator(noisy.window, expected)
                wear, rejection = wear.update(settings.trend, "b", estimate, now, settings.learning)
                seen += estimate.machine is not None and not rejection
            elif case.two_contacts:
                yield Looked(noisy, model, wear.known_machine(settings.learning, now))


def _cases(floor: float | None, gaps: int) -> Iterator[WindowCase]:
    """Windows that show both contacts, of gaps from 1 to 40 deg."""
    rng = np.random.default_rng(0)
    noise = None if floor is None else Noise(0.22e-3, (10.0, 50.0))
    for case in paper_loop_cases(np.radians(rng.uniform(1.0, 40.0, gaps)), PER_GAP, 2026, noise):
        if case.two_contacts:
            yield case.noisy((floor or 0.0) * rng.standard_normal(case.window.position.size))


def _estimated_share(
    looked: Sequence[Looked], messages: Sequence[WindowMessage], moved: float, usual: float, rng: np.random.Generator
) -> float:
    """Share of windows that would be estimated, the gap having moved by so much (deg) to either side."""
    decisions = []
    for (case, model, machine), message in zip(looked, messages, strict=True):
        for side in (1.0, -1.0):
            before = case.gap + math.radians(side * moved + KNOWN_DEG * float(rng.standard_normal()))
            if before > 0.0:
                watch = _watch(before, usual)
                decisions.append(glance(message, case.window, model, watch, machine=machine).moved)
    return float(np.mean(decisions))


def _glance_time(looked: Looked, message: WindowMessage, usual: float) -> float:
    """ms from bytes to verdict."""
    body, watch = encode(message), _watch(looked.case.gap, usual)
    begin = time.perf_counter()
    decoded = decode(body)
    assert isinstance(decoded, WindowMessage)
    glance(decoded, decode_window(decoded), looked.model, watch, machine=looked.machine)
    return 1e3 * (time.perf_counter() - begin)


def _watch(gap: float, usual: float) -> TriageState:
    return TriageState("", "b", 0, 0.0, gap, math.radians(KNOWN_DEG), misfit=usual)


def _message(case: WindowCase) -> WindowMessage:
    packed: list[Channel] = []
    for name, samples in case.window.channels.items():
        packed += (
            pack_finely(name, _UNITS[name], samples)
            if name == "theta_m"
            else [pack_channel(name, _UNITS[name], samples)]
        )
    rate = case.window.sample_rate
    return WindowMessage("axis", "b", 1, 0.0, rate, tuple(packed), (), 0, "m", "reference", checksum(packed))


def _table(rows: Sequence[GlanceRow]) -> Table:
    heads = [f"{moved:g} deg" for moved in MOVED_DEG]
    table = Table(
        "gap moved by", "windows", "error deg", "stated", *heads, "ms, least", "median", box=None, pad_edge=False
    )
    for row in rows:
        shares = [f"{100.0 * share:.1f} %" for share in row.seen]
        table.add_row(
            row.condition,
            f"{row.windows}",
            f"{row.error:.3f}",
            f"{row.std:.3f}",
            *shares,
            f"{row.least:.2f}",
            f"{row.median:.2f}",
        )
    return table
