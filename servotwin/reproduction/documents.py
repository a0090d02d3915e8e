"""claims.json and beyond.json: the measured numbers as JSON.

claims.json, schema ``servotwin-claims/1``::

    schema       "servotwin-claims/1"
    paper        the paper's reference
    version      servotwin's version
    definitions  meanings of settled, bias, the two references ...
    presets      {name: {"model": version of the preset's plant numbers}}
    claims       a list, in the paper's order, of
        id, sentence, where, criterion      texts, fixed before measuring
        amended                             reason for a change of the criterion after a measurement; "" without one
        results  {preset: {
            verdict   "reproduced" | "not as stated" | "cannot be checked"
            why       one sentence
            values    [{"name": text, "number": number or null, "unit": text}]   null: no such number
            unipolar  the same three for a reference of 0/1 mm, or null where the reference does not matter
        }}

beyond.json, schema ``servotwin-beyond/1``::

    schema       "servotwin-beyond/1"
    version      servotwin's version
    preset       name of the servo
    definitions  meanings of the measures
    figures      {name of the figure: a list, one entry per policy, of
        policy, refused      reason for which the policy designs nothing for this machine; "" where it does
        total                null, or voltage_v, voltage_at_rest_v (rms), travel_turns, estimates, windows,
                             updates, fallbacks
        steps                a list of begin_s, gap_rad, settled, error_m, overshoot, settling_s
    }

A number in claims.json is in the unit beside it. Files of equal runs differ only in the measured wall times.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import servotwin as st
from servotwin.reproduction import measures, policy_runs
from servotwin.reproduction.claims import Claim, ClaimResult, Finding, Value
from servotwin.reproduction.policy_runs import PolicyOutcome, PolicyStep, PolicyTotal

CLAIMS_SCHEMA, _BEYOND_SCHEMA = "servotwin-claims/1", "servotwin-beyond/1"
PAPER = (
    "Y. Vered and S. J. Elliott, The use of digital twins to remotely update feedback controllers for the motion"
    " control of nonlinear dynamic systems, Mechanical Systems and Signal Processing, 2023"
)
_UNITS = {
    "voltage": "v",
    "voltage_at_rest": "v",
    "travel": "turns",
    "begin": "s",
    "gap": "rad",
    "error": "m",
    "settling": "s",
}


def claims_json(results: Iterable[ClaimResult]) -> str:
    """Encode claims.json."""
    rows = results_by_claim(results)
    presets = {preset: {"model": st.Servo.preset(preset).version} for row in rows.values() for preset in row}
    return _dumps(
        {
            "schema": CLAIMS_SCHEMA,
            "paper": PAPER,
            "version": st.__version__,
            "definitions": measures.DEFINITIONS,
            "presets": presets,
            "claims": [_claim(claim, row) for claim, row in rows.items()],
        }
    )


def beyond_json(outcomes: Mapping[str, Sequence[PolicyOutcome]], preset: str) -> str:
    """Encode beyond.json from each figure's outcomes."""
    return _dumps(
        {
            "schema": _BEYOND_SCHEMA,
            "version": st.__version__,
            "preset": preset,
            "definitions": policy_runs.DEFINITIONS,
            "figures": {name: [_outcome(one) for one in rows] for name, rows in outcomes.items()},
        }
    )


def results_by_claim(results: Iterable[ClaimResult]) -> dict[Claim, dict[str, ClaimResult]]:
    """Group results by claim and preset, in the order in which they come."""
    rows: dict[Claim, dict[str, ClaimResult]] = {}
    for result in results:
        rows.setdefault(result.claim, {})[result.preset] = result
    return rows


def _dumps(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _claim(claim: Claim, row: Mapping[str, ClaimResult]) -> dict[str, Any]:
    texts = {name: getattr(claim, name) for name in ("id", "sentence", "where", "criterion", "amended")}
    return {**texts, "results": {preset: _result(result) for preset, result in row.items()}}


def _result(result: ClaimResult) -> dict[str, Any]:
    other = result.unipolar
    return {**_finding(result.finding), "unipolar": None if other is None else _finding(other)}


def _finding(finding: Finding) -> dict[str, Any]:
    return {"verdict": finding.verdict.value, "why": finding.why, "values": _values(finding.values)}


def _values(values: Sequence[Value]) -> list[dict[str, Any]]:
    return [{"name": v.name, "number": v.number if math.isfinite(v.number) else None, "unit": v.unit} for v in values]


def _outcome(one: PolicyOutcome) -> dict[str, Any]:
    return {
        "policy": one.policy,
        "refused": one.refused,
        "total": None if one.total is None else _with_units(one.total),
        "steps": [_with_units(step) for step in one.steps],
    }


def _with_units(row: PolicyStep | PolicyTotal) -> dict[str, Any]:
    """Fields by name with unit; null where there is no such number."""
    named = {f"{name}_{_UNITS[name]}" if name in _UNITS else name: value for name, value in asdict(row).items()}
    return {name: value if math.isfinite(value) else None for name, value in named.items()}
