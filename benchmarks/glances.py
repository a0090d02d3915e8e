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
from servotwin.estimation.whitened.quick import quick_fit
from servotwin.messages import Channel, WindowMessage, checksum, decode, encode, pack_channel, pack_finely
from servotwin.plant.noise import Noise
from servotwin.twin.estimating import decode_window
from servotwin.twin.triage import TriageState, glance

NAME, SCHEMA = "triage", "servotwin-bench-triage/1"
GAPS, QUICK = 160, 8
PER_GAP = 6
MOVED_DEG = (0.0, 0.1, 0.2, 0.3, 0.5)
KNOWN_DEG = 0.005
"""Spread of the gap before the glance."""
CONDITIONS = {"clean": None, "noise, floor 1 um": 1e-6, "noise, floor 10 um": 1e-5}
"""The paper's noise, on a white floor of so many m."""
_UNITS = {"position": "m", "theta_m": "rad", "voltage": "V", "reference": "m"}


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
    rows = tuple(_row(name, floor, gaps) for name, floor in CONDITIONS.items())
    console.print(_table(rows), highlight=False)
    report.write(output, report.text(SCHEMA, date, rows=[row._asdict() for row in rows]), console)
    return rows


def _row(name: str, floor: float | None, gaps: int) -> GlanceRow:
    cases = list(_cases(floor, gaps))
    fits = [quick_fit(case.window, case.servo, case.gap) for case in cases]
    errors = np.degrees([fit.gap - case.gap for fit, case in zip(fits, cases, strict=True)])
    usual = 1.5 * float(np.median([fit.misfit for fit in fits]))
    rng = np.random.default_rng(1)
    messages = [_message(case) for case in cases]
    shares = tuple(_estimated_share(cases, messages, moved, usual, rng) for moved in MOVED_DEG)
    times = [_glance_time(case, message, usual) for case, message in zip(cases, messages, strict=True)]
    error, std = float(np.sqrt(np.mean(errors**2))), math.degrees(float(np.median([fit.std for fit in fits])))
    return GlanceRow(name, len(cases), error, std, shares, min(times), float(np.median(times)))


def _cases(floor: float | None, gaps: int) -> Iterator[WindowCase]:
    """Windows that show both contacts, of gaps from 1 to 40 deg."""
    rng = np.random.default_rng(0)
    noise = None if floor is None else Noise(0.22e-3, (10.0, 50.0))
    for case in paper_loop_cases(np.radians(rng.uniform(1.0, 40.0, gaps)), PER_GAP, 2026, noise):
        if case.two_contacts:
            yield case.noisy((floor or 0.0) * rng.standard_normal(case.window.position.size))


def _estimated_share(
    cases: Sequence[WindowCase], messages: Sequence[WindowMessage], moved: float, usual: float, rng: np.random.Generator
) -> float:
    """Share of windows that would be estimated, the gap having moved by so much (deg) to either side."""
    decisions = []
    for case, message in zip(cases, messages, strict=True):
        for side in (1.0, -1.0):
            before = case.gap + math.radians(side * moved + KNOWN_DEG * float(rng.standard_normal()))
            if before > 0.0:
                decisions.append(glance(message, case.window, case.servo, _watch(before, usual)).moved)
    return float(np.mean(decisions))


def _glance_time(case: WindowCase, message: WindowMessage, usual: float) -> float:
    """ms from bytes to verdict."""
    body, watch = encode(message), _watch(case.gap, usual)
    begin = time.perf_counter()
    decoded = decode(body)
    assert isinstance(decoded, WindowMessage)
    glance(decoded, decode_window(decoded), case.servo, watch)
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
