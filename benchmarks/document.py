"""Results as JSON: everything that was measured, and on what."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from benchmarks.contest import Workload
from benchmarks.measure import Row

SCHEMA = "servotwin-bench/1"


@dataclass(frozen=True)
class Result:
    """A workload and what was measured of its contestants, servotwin first."""

    workload: Workload
    rows: tuple[Row, ...]

    def ratio(self, row: Row) -> float:
        """Median over the rounds of the time over servotwin's in the same round."""
        return median(row.ratios(self.rows[0]))

    def note(self, row: Row) -> str:
        """What there is to say beside the numbers."""
        if row.missing:
            return row.missing
        return ", ".join(part for part in (self.workload.pace(row.median), row.remark) if part)


def dumps(results: Sequence[Result], machine: Mapping[str, Any], date: str, quick: bool) -> str:
    """The document: schema, date, machine, and for each workload every run of every contestant."""
    document = {
        "schema": SCHEMA,
        "date": date,
        "quick": quick,
        "machine": dict(machine),
        "workloads": [_workload(result) for result in results],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _workload(result: Result) -> dict[str, Any]:
    return {
        "name": result.workload.name,
        "title": result.workload.title,
        "units": {check.name: check.unit for check in result.workload.checks},
        "contestants": [_row(result, row) for row in result.rows],
    }


def _row(result: Result, row: Row) -> dict[str, Any]:
    if row.missing:
        return {"name": row.name, "missing": row.missing}
    return {
        "name": row.name,
        "median_s": row.median,
        "ratio": result.ratio(row),
        "ratios": list(row.ratios(result.rows[0])),
        "first_s": row.first,
        "rounds_s": [list(times) for times in row.rounds],
        "errors": {name: None if math.isnan(value) else value for name, value in row.errors.items()},
        "note": result.note(row),
    }
