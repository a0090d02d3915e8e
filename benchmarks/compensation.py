"""`servotwin bench compensation`: pulses that carry the motor across the gap at reversals, and velocity feedforward.

All moves of a machine are equally long, so that a pulse at each reversal that carries the motor across a share of the
gap is a velocity feedforward of the machine's own: ``k_B (velocity / p + share * gap / step)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import report
from servotwin.control.controller import Controller
from servotwin.control.laws import filtered_pid
from servotwin.control.retuning import scaled
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic
from servotwin.redesign.certified.machines import SimulatedMachines, draw_independently
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.simulation.sampled_ensemble import SampledCases, summarise_sampled

NAME, SCHEMA = "compensation", "servotwin-bench-compensation/1"
MACHINES, QUICK, SEED = 60, 4, 1
RATE, MOVE, MOVES = 500.0, 8.0, 6
KNOWN = Uncertainty(k=0.05, c=0.3, k_B=0.1, m=0.0, k_T=0.1, gap=(math.radians(5.0), math.radians(30.0)))
SCALES = (0.7, 0.85, 1.0)
FORMS = {
    "none": (0.0, 0.0),
    "gap x 0.5": (0.0, 0.5),
    "gap x 0.8": (0.0, 0.8),
    "gap x 0.95": (0.0, 0.95),
    "gap x 1.2": (0.0, 1.2),
    "velocity x 0.3": (0.3, 0.0),
    "velocity x 0.5": (0.5, 0.0),
    "velocity x 0.3, gap x 0.5": (0.3, 0.5),
    "velocity x 0.5, gap x 0.5": (0.5, 0.5),
}
"""Velocity feedforward relative to the back EMF, and the share of the gap that the pulses cross."""
TIMES = (0.01, 0.05, 0.114)
"""s, time constants of the pulses."""
_OVERSHOOT = 0.5


class CompensationRow(NamedTuple):
    """One form of compensation with one time constant and one gain, or the cheapest of all for every machine.

    Attributes
    ----------
    form : str
    time : float
        s; NaN: the best for every machine.
    scale : float
        Factor on the servo's Kp and Kd; NaN: the best for every machine.
    mean, p95 : float
        s, of the machines: integral of the absolute error per step, mean of all moves.
    overshoot : float
        Per step, 95th percentile.
    """

    form: str
    time: float
    scale: float
    mean: float
    p95: float
    overshoot: float


def compensation(
    date: str = "", output: Path | None = None, count: int = MACHINES, console: Console | None = None, seed: int = SEED
) -> tuple[CompensationRow, ...]:
    """Compare forms of compensation on machines that move to and fro; print, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count, seed : int
        Machines.
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    servo = Servo.preset("paper").replace(sample_rate=RATE, Ki=0.0)
    machines = draw_independently(servo, KNOWN, count, seed)
    rows = [row for form in FORMS for row in _rows(form, servo, machines)]
    console.print(_shown(rows))
    report.write(output, report.text(SCHEMA, date, rows=[row._asdict() for row in rows]), console)
    return tuple(rows)


def _rows(form: str, servo: Servo, machines: SimulatedMachines) -> list[CompensationRow]:
    """Rows of each gain with its best time constant, and of the best of all for every machine."""
    options = [(time, scale) for time in (TIMES if form != "none" else TIMES[:1]) for scale in SCALES]
    found = [_measured(servo, machines, form, *option) for option in options]
    costs, overshoots = (np.array(values) for values in zip(*found, strict=True))
    rows = []
    for scale in SCALES:
        k = min((k for k, option in enumerate(options) if option[1] == scale), key=lambda k: float(costs[k].mean()))
        rows.append(_row(form, *options[k], costs[k], overshoots[k]))
    best = np.argmin(np.where(overshoots <= _OVERSHOOT, costs, np.inf), axis=0)
    every = np.arange(machines.count)
    return [*rows, _row(form, math.nan, math.nan, costs[best, every], overshoots[best, every])]


def _row(form: str, time: float, scale: float, costs: Array, overshoots: Array) -> CompensationRow:
    p95, beyond = np.percentile(costs, 95.0), np.percentile(overshoots, 95.0)
    return CompensationRow(form, time, scale, float(costs.mean()), float(p95), float(beyond))


def _measured(servo: Servo, machines: SimulatedMachines, form: str, time: float, scale: float) -> tuple[Array, Array]:
    """(count,) costs (s) and overshoots of the machines under one gain."""
    velocity, share = FORMS[form]
    gap, step = machines.gap[:, 0], machines.step[:, 0]
    fed = servo.k_B * (velocity / servo.p + share * gap / step)
    own = filtered_pid(scaled(servo.controller, scale, (1.0, 1.0), 0.0))
    laws = np.array([_law(own, each, time) for each in fed.tolist()], dtype=object)
    plants = np.array(machines.plants, dtype=object)
    begins = MOVE * np.arange(MOVES)
    shape = PiecewiseCubic.zero_order_hold(begins, 1.0 - np.arange(MOVES) % 2)
    cases = SampledCases(step, gap, 0.0, machines.theta_d0[:, 0])
    figures = summarise_sampled(
        plants, laws, MOVE * MOVES, cases, MOVE / 3.0, None, ("error", "position"), 100.0, None, shape
    )
    beyond = np.maximum(figures["position"].highest - step, -figures["position"].lowest)
    return figures["error"].mean_size * MOVE / step, beyond / step


def _law(own: Controller, fed: float, time: float) -> Controller:
    return own.replace(velocity_feedforward=fed, velocity_time=time)


def _shown(rows: Sequence[CompensationRow]) -> Table:
    """A line for each form and gain."""
    table = Table(title="compensation at reversals, 500 Hz, machines that move to and fro", box=None, pad_edge=False)
    for heading in ("form", "time s", "Kp, Kd x", "cost mean s", "cost p95 s", "overshoot p95 %"):
        table.add_column(heading, justify="left" if heading == "form" else "right")
    for row in rows:
        each = math.isnan(row.scale)
        numbers = f"{row.mean:.3f}", f"{row.p95:.3f}", f"{100.0 * row.overshoot:.0f}"
        table.add_row(row.form, "best" if each else f"{row.time:g}", "best" if each else f"{row.scale:g}", *numbers)
    return table
