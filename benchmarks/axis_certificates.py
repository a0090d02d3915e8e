"""Verified settings of the axis presets on fresh machines, with the presets' own controllers beside them.

``python -m benchmarks.batch axes-fresh --seed 5 --count 200 FILE`` verifies a setting for each preset, for any gap up
to the largest and for a gap that is known, and simulates machines that no verification has seen: each setting where it
is verified, and the preset's own controller on the same ones. The blocks are the presets.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.batch import Batch
from benchmarks.preset_machines import DUTIES, stated_ranges
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.settling_test import share_at_least
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

NAME = "axes-fresh"
# Healthy gaps: ends of an estimate's interval.
_KNOWN = (4.95, 5.05)


class _Task(NamedTuple):
    name: str
    question: str
    machines: int
    seed: int


def questions(name: str) -> Mapping[str, Uncertainty]:
    """Ranges of a machine for which a setting is asked: any gap, and one that an estimate has told."""
    whole, motor_gap = stated_ranges(name), DUTIES[name].gap / Axis.preset(name).p
    return {"any gap": whole, "gap known": whole.replace(gap=(_KNOWN[0] * motor_gap, _KNOWN[1] * motor_gap))}


def measured(task: _Task) -> dict[str, Any]:
    """Measure a question: the certificate, and its setting and the own controller on fresh machines."""
    axis, known, demands = Axis.preset(task.name), questions(task.name)[task.question], Demands()
    try:
        found = certify(axis, known, demands)
    except InvalidInput as error:
        return {"refused": str(error)}
    own = Design(axis.controller, 0.0)
    settings = [own] if isinstance(found, NotVerified) else [own, found.setting]
    machines = draw_independently(axis, known, task.machines, task.seed)
    figures = [
        {
            "settled": int(each.settled.sum()),
            "cost": float(np.percentile(each.cost, 95.0)),
            "tail": float(each.tail.max()) / axis.p,
        }
        for each in assess(settings, machines, trial_for(axis, known, demands))
    ]
    result = {"count": task.machines, "own": figures[0]}
    return result | ({"refused": found.reason} if isinstance(found, NotVerified) else _verified(found, figures[1]))


def _verified(found: Certificate, figures: Mapping[str, float]) -> dict[str, Any]:
    assert found.loop is not None
    return {"setting": figures, "members": found.members, "Ms": found.loop.Ms_worst, "seconds": found.seconds}


def _units(names: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, _Task]]:
    for name in names:
        for question in questions(name):
            yield f"{seed}/{name}/{question}", _Task(name, question, count, seed)


def _show(found: Mapping[str, Any], console: Console) -> None:
    """A line for each question, and what was refused."""
    table = Table(title="verified settings on fresh machines", title_justify="left", box=None)
    table.add_column("preset")
    table.add_column("ranges")
    for heading in (
        *("fresh\nmachines", "settled", "share at\nleast %", "cost p95\ns", "own:\nsettled", "own: cost\np95 s"),
        *("tail, largest\n% of healthy gap", "Ms", "verified\nin s"),
    ):
        table.add_column(heading, justify="right")
    notes = []
    for key, numbers in found.items():
        _, name, question = key.split("/")
        table.add_row(name, question, *_line(name, numbers))
        if "refused" in numbers:
            notes.append(f"{name}, {question}: {numbers['refused']}")
    console.print(table)
    for note in notes:
        console.print(note, markup=False, highlight=False)


def _line(name: str, numbers: Mapping[str, Any]) -> list[str]:
    if "own" not in numbers:
        return ["-"] * 9
    count, own = numbers["count"], numbers["own"]
    beside = [str(own["settled"]), f"{own['cost']:.3g}"]
    if "setting" not in numbers:
        return [str(count), "-", "-", "-", *beside, *["-"] * 3]
    setting, healthy = numbers["setting"], DUTIES[name].gap / Axis.preset(name).p
    least = share_at_least(setting["settled"], count, Demands().confidence)
    return [
        str(count),
        str(setting["settled"]),
        f"{100.0 * least:.1f}",
        f"{setting['cost']:.3g}",
        *beside,
        f"{100.0 * setting['tail'] / healthy:.3g}",
        f"{numbers['Ms']:.2f}",
        f"{numbers['seconds']:.2g}",
    ]


BATCH = Batch(_units, measured, _show, tuple(DUTIES))
"""For `benchmarks.batch`."""
