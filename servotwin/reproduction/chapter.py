"""The chapter "Beyond the paper": tables for the report, and the same numbers for machines.

beyond.json, schema ``servotwin-beyond/1``::

    schema       "servotwin-beyond/1"
    version      servotwin's version
    preset       name of the servo
    definitions  what the words mean
    figures      {name of the figure: a list, one per policy, of
        policy, refused      why it designs nothing for this machine; "" where it does
        total                null, or voltage_v, voltage_at_rest_v (rms), travel_turns, estimates, windows,
                             updates, fallbacks
        steps                a list of begin_s, gap_rad, settled, error_m, overshoot, settling_s
    }
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from html import escape
from typing import Any

import servotwin as st
from servotwin.report import page
from servotwin.reproduction import document
from servotwin.reproduction.beyond import DEFINITIONS, Outcome, StepRow, Total, worst

SCHEMA = "servotwin-beyond/1"
UNITS = {
    "voltage": "v",
    "voltage_at_rest": "v",
    "travel": "turns",
    "begin": "s",
    "gap": "rad",
    "error": "m",
    "settling": "s",
}
HEADS = (
    "Policy",
    "Steps settled",
    "Error left, worst (mm)",
    "mean (mm)",
    "Settling time of settled steps, worst (s)",
    "Overshoot, worst (%)",
    "Voltage rms (V)",
    "at rest (V)",
    "Motor travel (turns)",
    "Estimates accepted",
    "Updates",
    "Fallbacks",
)
EMPTY = "–"
MM = 1e3


def dumps(measured: Mapping[str, Sequence[Outcome]], preset: str) -> str:
    """beyond.json for the figures that were drawn."""
    found = {
        "schema": SCHEMA,
        "version": st.__version__,
        "preset": preset,
        "definitions": words(),
        "figures": {name: [_outcome(one) for one in outcomes] for name, outcomes in measured.items()},
    }
    return json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def tables(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """One table for the whole runs, one for the steps, as HTML."""
    yield page.table(HEADS, [total_cells(one) for one in outcomes])
    ran = [one for one in outcomes if one.total is not None]
    yield "<p>The error left at the end of each step (mm); ✗: the step does not settle.</p>"
    yield page.table(("Step at (s)", "Gap (deg)", *(one.policy for one in ran)), step_cells(ran))
    yield from (f"<p><code>{one.policy}</code>: {escape(one.refused)}.</p>" for one in outcomes if one.refused)


def total_cells(one: Outcome) -> tuple[str, ...]:
    """A policy's whole run as texts, in the order of `HEADS`."""
    if one.total is None:
        return (one.policy, *(EMPTY for _ in HEADS[1:]))
    total, errors = one.total, [step.error for step in one.steps]
    return (
        one.policy,
        f"{sum(step.settled for step in one.steps)} of {len(one.steps)}",
        f"{worst(one.steps, 'error') * MM:.4f}",
        f"{MM * math.fsum(errors) / len(errors):.4f}" if errors else EMPTY,
        f"{worst([step for step in one.steps if step.settled], 'settling'):.1f}",
        f"{100.0 * worst(one.steps, 'overshoot'):.1f}",
        f"{total.voltage:.4f}",
        f"{total.voltage_at_rest:.4f}",
        f"{total.travel:.1f}",
        f"{total.estimates} of {total.windows}",
        str(total.updates),
        str(total.fallbacks),
    )


def step_cells(ran: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """Every step as texts, one column per policy."""
    rows = zip(*(one.steps for one in ran), strict=True)
    return [(f"{row[0].begin:.0f}", f"{math.degrees(row[0].gap):.1f}", *map(_left, row)) for row in rows]


def words() -> dict[str, str]:
    """What the tables' words mean."""
    return {**{word: document.DEFINITIONS[word] for word in ("settled", "settling time")}, **DEFINITIONS}


def _left(step: StepRow) -> str:
    return f"{step.error * MM:.4f}{'' if step.settled else ' ✗'}"


def _outcome(one: Outcome) -> dict[str, Any]:
    total = None if one.total is None else _plain(one.total)
    return {
        "policy": one.policy,
        "refused": one.refused,
        "total": total,
        "steps": [_plain(step) for step in one.steps],
    }


def _plain(row: StepRow | Total) -> dict[str, Any]:
    """By name with unit; null where there is no such number."""
    named = {f"{name}_{UNITS[name]}" if name in UNITS else name: value for name, value in asdict(row).items()}
    return {name: value if math.isfinite(value) else None for name, value in named.items()}
