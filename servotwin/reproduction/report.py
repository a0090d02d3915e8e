"""report.html: verdicts, figures and errata on one self-contained page."""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import NamedTuple

import servotwin as st
from servotwin.report.page import page
from servotwin.reproduction import figures, measures, policy_runs
from servotwin.reproduction.claims import Claim, ClaimResult, Finding, Value, Verdict
from servotwin.reproduction.documents import PAPER, results_by_claim
from servotwin.reproduction.figures import DrawnFigure
from servotwin.reproduction.policy_runs import PolicyOutcome, PolicyStep, worst

ResultByPreset = Mapping[str, ClaimResult]
TITLE = "servotwin: the paper, claim by claim"
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
_EMPTY = "–"
MM = 1e3


def report(results: Sequence[ClaimResult], drawn: Sequence[DrawnFigure], preset: str) -> str:
    """Compose the page; sections without content are left out."""
    rows = results_by_claim(results)
    papers, ours = split(drawn)
    return page(
        "claims.html",
        TITLE,
        paper=PAPER,
        cards=_cards(rows),
        rows=[_row(claim, row) for claim, row in rows.items()],
        preset=preset,
        papers=papers,
        beyond=[(one, policy_tables(one.outcomes) if one.outcomes else None) for one in ours],
        heads=HEADS,
        policy_words=list(policy_runs.DEFINITIONS.items()) if any(one.outcomes for one in ours) else [],
        errata=[[erratum[name] for name in ("id", "where", "problem", "decision")] for erratum in errata()],
        words=list(measures.DEFINITIONS.items()),
        version=st.__version__,
    )


def errata() -> list[dict[str, str]]:
    """Read the errata: id, where, problem, decision."""
    text = resources.files("servotwin.reproduction").joinpath("errata.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["erratum"])


def _cards(rows: Mapping[Claim, ResultByPreset]) -> list[dict[str, object]]:
    """Count the verdicts of each preset."""
    presets = list(next(iter(rows.values()), ()))
    return [_card(preset, [row[preset].finding.verdict for row in rows.values()]) for preset in presets]


def _card(preset: str, verdicts: Sequence[Verdict]) -> dict[str, object]:
    counts = Counter(verdicts)
    rest = ", ".join(f"{counts[v]} {v.value}" for v in list(Verdict)[1:] if counts[v])
    return {"preset": preset, "reproduced": counts[Verdict.REPRODUCED], "claims": len(verdicts), "rest": rest}


def _row(claim: Claim, row: ResultByPreset) -> dict[str, object]:
    findings = {preset: result.finding for preset, result in row.items()}
    findings |= {f"{preset}, 0/1 mm": r.unipolar for preset, r in row.items() if r.unipolar}
    return {
        "claim": claim,
        "place": f"§\u00a0{claim.where}" if claim.where[0].isdigit() else claim.where,
        "verdicts": [_verdict(preset, result) for preset, result in row.items()],
        "findings": findings,
        "head": ("measured", *findings),
        "numbers": _numbers(findings),
    }


def _verdict(preset: str, result: ClaimResult) -> dict[str, str]:
    """Verdict, and in `other` that for the other reading of the reference where it differs."""
    verdict, other = result.finding.verdict, result.unipolar
    differs = other is not None and other.verdict is not verdict
    return {"preset": preset, "value": verdict.value, "other": other.verdict.value if other and differs else ""}


def _numbers(findings: Mapping[str, Finding]) -> list[list[str]]:
    """All values, one row each, one column per finding."""
    columns = {name: {(v.name, v.unit): v for v in finding.values} for name, finding in findings.items()}
    keys = list(dict.fromkeys(key for column in columns.values() for key in column))
    return [[_name(*key), *(_format(c.get(key)) for c in columns.values())] for key in keys]


def _name(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _format(value: Value | None) -> str:
    """Format a number with four digits; a dash where there is none."""
    if value is None or not math.isfinite(value.number):
        return "–"
    return f"{value.number:.4g}"


class PolicyTables(NamedTuple):
    """Texts of policies that are compared.

    Attributes
    ----------
    totals : list of tuple of str
        A whole run each, in the order of `HEADS`.
    head : tuple of str
        Of the table of steps.
    steps : list of tuple of str
    refused : list of (str, str)
        Policies that did not run, and why.
    """

    totals: list[tuple[str, ...]]
    head: tuple[str, ...]
    steps: list[tuple[str, ...]]
    refused: list[tuple[str, str]]


def policy_tables(outcomes: Sequence[PolicyOutcome]) -> PolicyTables:
    """Word the outcomes of policies."""
    ran = [one for one in outcomes if one.total is not None]
    return PolicyTables(
        [_total_cells(one) for one in outcomes],
        ("Step at (s)", "Gap (deg)", *(one.policy for one in ran)),
        _step_cells(ran),
        [(one.policy, one.refused) for one in outcomes if one.refused],
    )


def _total_cells(one: PolicyOutcome) -> tuple[str, ...]:
    """Word a policy's whole run, in the order of `HEADS`."""
    if one.total is None:
        return (one.policy, *(_EMPTY for _ in HEADS[1:]))
    total, errors = one.total, [step.error for step in one.steps]
    return (
        one.policy,
        f"{sum(step.settled for step in one.steps)} of {len(one.steps)}",
        f"{worst(one.steps, 'error') * MM:.4f}",
        f"{MM * math.fsum(errors) / len(errors):.4f}" if errors else _EMPTY,
        f"{worst([step for step in one.steps if step.settled], 'settling'):.1f}",
        f"{100.0 * worst(one.steps, 'overshoot'):.1f}",
        f"{total.voltage:.4f}",
        f"{total.voltage_at_rest:.4f}",
        f"{total.travel:.1f}",
        f"{total.estimates} of {total.windows}",
        str(total.updates),
        str(total.fallbacks),
    )


def _step_cells(ran: Sequence[PolicyOutcome]) -> list[tuple[str, ...]]:
    """Word every step, one column per policy."""
    rows = zip(*(one.steps for one in ran), strict=True)
    return [(f"{row[0].begin:.0f}", f"{math.degrees(row[0].gap):.1f}", *map(_left, row)) for row in rows]


def _left(step: PolicyStep) -> str:
    return f"{step.error * MM:.4f}{'' if step.settled else ' ✗'}"


def split(drawn: Sequence[DrawnFigure]) -> tuple[list[DrawnFigure], list[DrawnFigure]]:
    """Split the figures into the paper's and those beyond it."""
    beyond = {one.name for one in figures.BEYOND}
    return [one for one in drawn if one.name not in beyond], [one for one in drawn if one.name in beyond]
