"""`servotwin bench friction`: a known share of the Coulomb friction fed forward, beside integral action.

Machines of the block *friction* of `bench loops` under one law throughout; the friction of each is known exactly.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.policies.loops import scored
from benchmarks.policies.worn import WornMachine, worn_machines
from servotwin.control.controller import Controller
from servotwin.control.laws import filtered_pid
from servotwin.control.retuning import scaled

NAME, SCHEMA = "friction", "servotwin-bench-friction/1"
MACHINES, QUICK, SEED = 20, 2, 1
_INTEGRAL = 0.03
_VELOCITY_TIME = 0.5
FORMS = tuple(itertools.product((0.6, 0.85), (0.3, 0.5), (0.0, 0.5, 0.8, 0.9, 1.0, 1.1)))
"""Factor on Kp and Kd, velocity feedforward relative to the back EMF, share of the friction that is fed forward."""


class FrictionRow(NamedTuple):
    """One law on all machines.

    Attributes
    ----------
    law : str
    share : float
        Share of each machine's friction that is fed forward.
    median, p95 : float
        s, of the machines: integral of the absolute error per step, mean of all steps.
    settled : float
        Share of the machines whose last step has settled.
    tail : float
        m, 95th percentile of the largest error in the end.
    """

    law: str
    share: float
    median: float
    p95: float
    settled: float
    tail: float


def compare(
    date: str = "", output: Path | None = None, count: int = MACHINES, console: Console | None = None, seed: int = SEED
) -> tuple[FrictionRow, ...]:
    """Compare laws with and without a friction feedforward; print, and write JSON if `output` is given.

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
    machines = worn_machines("friction", count, seed)
    rows = [_row(f"Kp, Kd x 1, Ki x {_INTEGRAL:g}", 0.0, machines, (1.0, 0.0, _INTEGRAL))]
    for scale, velocity, share in FORMS:
        rows.append(_row(f"Kp, Kd x {scale:g}, velocity x {velocity:g}", share, machines, (scale, velocity, 0.0)))
    console.print(_shown(rows))
    report.write(output, report.text(SCHEMA, date, rows=[row._asdict() for row in rows]), console)
    return tuple(rows)


def _row(name: str, share: float, machines: Sequence[WornMachine], law: tuple[float, float, float]) -> FrictionRow:
    """One law on all machines, with a share of the friction of each."""
    runs = [scored(machine, machine.under(_law(machine, share, *law))) for machine in machines]
    costs, tails = [run.cost for run in runs], [run.tail for run in runs]
    (median, p95), tail = np.percentile(costs, (50.0, 95.0)), np.percentile(tails, 95.0)
    return FrictionRow(
        name, share, float(median), float(p95), float(np.mean([run.settled for run in runs])), float(tail)
    )


def _law(machine: WornMachine, share: float, scale: float, velocity: float, integral: float) -> Controller:
    """The servo's own law, scaled, with feedforwards."""
    own, needed = machine.model.controller, machine.model.k_B / machine.model.p
    return filtered_pid(scaled(own, scale, (1.0, 1.0), integral)).replace(
        velocity_feedforward=velocity * needed,
        velocity_time=_VELOCITY_TIME * needed / own.Kp,
        friction_feedforward=share * machine.friction * machine.plant.R / machine.plant.k_T,
    )


def _shown(rows: Sequence[FrictionRow]) -> Table:
    """A line for each law."""
    table = Table(title="friction fed forward, 1 kHz, machines that move to and fro", box=None, pad_edge=False)
    for heading in ("law", "of the friction", "cost median s", "cost p95 s", "settled %", "tail p95 um"):
        table.add_column(heading, justify="left" if heading == "law" else "right")
    for row in rows:
        numbers = f"{row.share:g}", f"{row.median:.3f}", f"{row.p95:.3f}", f"{100.0 * row.settled:.0f}"
        table.add_row(row.law, *numbers, f"{1e6 * row.tail:.1f}")
    return table
