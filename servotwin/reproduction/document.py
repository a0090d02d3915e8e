"""claims.json: what was measured, for machines.

Schema ``servotwin-claims/1``::

    schema       "servotwin-claims/1"
    paper        the paper's reference
    version      servotwin's version
    definitions  what settled, bias and the two references mean
    presets      {name: {"model": version of the preset's plant numbers}}
    claims       a list, in the paper's order, of
        id, sentence, where, criterion      texts, fixed before measuring
        amended                             why the criterion was changed after a measurement; "" where it was not
        results  {preset: {
            verdict   "reproduced" | "not as stated" | "cannot be checked"
            why       one sentence
            values    [{"name": text, "number": number or null, "unit": text}]   null: no such number
            unipolar  the same three for a reference of 0/1 mm, or null where the reference does not matter
        }}

Numbers are in the unit named beside them. Files of equal runs differ only in the measured wall times.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import servotwin as st
from servotwin.reproduction.claims import Claim, Finding, Result, Value
from servotwin.reproduction.measures import BAND, SETTLED, TAIL

SCHEMA = "servotwin-claims/1"
PAPER = (
    "Y. Vered and S. J. Elliott, The use of digital twins to remotely update feedback controllers for the motion"
    " control of nonlinear dynamic systems, Mechanical Systems and Signal Processing, 2023"
)
DEFINITIONS = {
    "gap": "the total lost motion of the backlash",
    "tolerance": "half-width of the dead zone on the tracking error",
    "amplitude": f"half the peak-to-peak of the position over the last {TAIL:g} s of a step",
    "settled": f"an amplitude below {100 * SETTLED:g} % of the reference amplitude of 1 mm",
    "bias": f"the reference minus the mean position over the last {TAIL:g} s of a step",
    "settling time": f"from when on the position stays within {100 * BAND:g} % of the step around its end value",
    "reference": "a square wave of ±1 mm and 40 s; unipolar: 0/1 mm",
}


def document(results: Iterable[Result]) -> dict[str, Any]:
    """The whole document as plain dictionaries and lists."""
    rows = by_claim(results)
    presets = {preset: {"model": st.Servo.preset(preset).version} for row in rows.values() for preset in row}
    return {
        "schema": SCHEMA,
        "paper": PAPER,
        "version": st.__version__,
        "definitions": DEFINITIONS,
        "presets": presets,
        "claims": [_claim(claim, row) for claim, row in rows.items()],
    }


def dumps(results: Iterable[Result]) -> str:
    """The document as JSON."""
    return json.dumps(document(results), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def by_claim(results: Iterable[Result]) -> dict[Claim, dict[str, Result]]:
    """Results by claim and preset, in the order in which they come."""
    rows: dict[Claim, dict[str, Result]] = {}
    for result in results:
        rows.setdefault(result.claim, {})[result.preset] = result
    return rows


def _claim(claim: Claim, row: Mapping[str, Result]) -> dict[str, Any]:
    texts = {name: getattr(claim, name) for name in ("id", "sentence", "where", "criterion", "amended")}
    return {**texts, "results": {preset: _result(result) for preset, result in row.items()}}


def _result(result: Result) -> dict[str, Any]:
    other = result.unipolar
    return {**_finding(result.finding), "unipolar": None if other is None else _finding(other)}


def _finding(finding: Finding) -> dict[str, Any]:
    return {"verdict": finding.verdict.value, "why": finding.why, "values": _values(finding.values)}


def _values(values: Sequence[Value]) -> list[dict[str, Any]]:
    return [{"name": v.name, "number": v.number if math.isfinite(v.number) else None, "unit": v.unit} for v in values]
