"""Verified settings of random axes on fresh machines: no preset, but what a stranger has.

``python -m benchmarks.batch settings-random --seed 5 --count 20 FILE`` asks for a setting of each axis that
`axes-random` draws, for a gap known to 5 % and steps of one to three amplitudes, and simulates it on 200 machines that
no verification has seen, with the axis' own controller on the same ones. The blocks are the actuators.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.batch import Batch
from benchmarks.random_axes import BLOCKS, AxisTask, axis_tasks, random_axis
from servotwin.errors import InvalidInput
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

NAME = "settings-random"
_KNOWN, _STEPS = 0.05, 3.0  # half-width of the gap's interval, largest step in amplitudes
_MACHINES = 200


def measured(task: AxisTask) -> dict[str, Any]:
    """Measure an axis: whether a setting is verified, and where that and the own controller settle."""
    drawn = random_axis(task.block, task.seed, task.place)
    ends = ((1.0 - _KNOWN) * drawn.gap, (1.0 + _KNOWN) * drawn.gap)
    known, demands = Uncertainty(gap=ends, step=(drawn.amplitude, _STEPS * drawn.amplitude)), Demands()
    try:
        found = certify(drawn.model, known, demands)
    except InvalidInput as error:
        return {"refused": str(error)}
    if not isinstance(found, Certificate):
        return {"refused": found.reason}
    machines = draw_independently(drawn.model, known, _MACHINES, task.seed)
    settings = [Design(drawn.model.controller), found.setting]
    own, verified = assess(settings, machines, trial_for(drawn.model, known, demands))
    law = found.setting.controller
    return {
        "opens": bool(found.setting.tolerance) and not law.integral_only,
        "settled": int(verified.settled.sum()),
        "own": int(own.settled.sum()),
        "cost": float(np.percentile(verified.cost, 95.0)),
        "seconds": found.seconds,
    }


def _show(found: Mapping[str, Any], console: Console) -> None:
    table = Table(title=f"verified settings of random axes on {_MACHINES} fresh machines", box=None)
    for heading in ("actuator", "axes", "verified", "by a dead zone", "settled, least", "own: settled, mean"):
        table.add_column(heading, justify="left" if heading == "actuator" else "right")
    for block in BLOCKS:
        every = [numbers for key, numbers in found.items() if key.split("/")[1] == block]
        table.add_row(block, *_line(every))
    console.print(table)
    for key, numbers in found.items():
        if "refused" in numbers:
            console.print(f"{key}: {numbers['refused']}", markup=False, highlight=False)


def _line(every: Sequence[Mapping[str, Any]]) -> list[str]:
    verified = [numbers for numbers in every if "settled" in numbers]
    counts = [str(len(every)), str(len(verified)), str(sum(numbers["opens"] for numbers in verified))]
    if not verified:
        return [*counts, "-", "-"]
    least, own = min(numbers["settled"] for numbers in verified), np.mean([numbers["own"] for numbers in verified])
    return [*counts, str(least), f"{own:.0f}"]


BATCH = Batch(axis_tasks, measured, _show, BLOCKS)
"""For `benchmarks.batch`."""
