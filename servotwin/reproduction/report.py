"""report.html: verdicts, figures and errata on one self-contained page."""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib import resources

import servotwin as st
from servotwin.report import page
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
    body = [*_head(rows, drawn)]
    if rows:
        body += _claims(rows)
    papers, ours = split(drawn)
    if papers:
        body += _figures(papers, preset)
    if ours:
        body += _beyond(ours, preset)
    body += [*_errata(), *_how()]
    return page.page(TITLE, body)


def errata() -> list[dict[str, str]]:
    """Read the errata: id, where, problem, decision."""
    text = resources.files("servotwin.reproduction").joinpath("errata.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["erratum"])


def _head(rows: Mapping[Claim, ResultByPreset], drawn: Sequence[DrawnFigure]) -> Iterator[str]:
    yield f"<h1>{escape(TITLE)}</h1>"
    yield f"<p>The claims of {escape(PAPER)}, beside the measurements of this package.</p>"
    links = [
        ("claims", "Claims", rows),
        ("figures", "Figures", split(drawn)[0]),
        ("beyond", "Beyond the paper", split(drawn)[1]),
        ("errata", "Errata", True),
        ("how", "How", True),
    ]
    yield "<nav>" + "".join(f'<a href="#{name}">{text}</a>' for name, text, there in links if there) + "</nav>"


def _claims(rows: Mapping[Claim, ResultByPreset]) -> Iterator[str]:
    presets = list(next(iter(rows.values())))
    yield '<h2 id="claims">Verdicts</h2>'
    yield _summary(rows, presets)
    yield (
        "<p>The printed gains do not fit the printed table (erratum E1). Every claim is therefore measured in three"
        " presets: <code>paper</code> has the pitch doubled, <code>table1</code> is as printed,"
        " <code>paper-gain2</code> has the gains doubled. The sentences are quoted from the paper, some of them"
        " shortened. Open a row to see the criterion and the numbers.</p>"
    )
    heads = "".join(f"<span>{escape(preset)}</span>" for preset in presets)
    yield f'<div class="claims"><div class="row head"><span>Claim</span>{heads}</div>'
    yield from (_row(claim, row) for claim, row in rows.items())
    yield "</div>"


def _summary(rows: Mapping[Claim, ResultByPreset], presets: Sequence[str]) -> str:
    cards = "".join(_card(preset, [row[preset].finding.verdict for row in rows.values()]) for preset in presets)
    return f'<div class="sum">{cards}</div>'


def _card(preset: str, verdicts: Sequence[Verdict]) -> str:
    counts = Counter(verdicts)
    total = f"<strong>{counts[Verdict.REPRODUCED]} of {len(verdicts)}</strong> reproduced"
    rest = ", ".join(f"{counts[v]} {v.value}" for v in list(Verdict)[1:] if counts[v])
    return f'<div><code>{escape(preset)}</code><br>{total}<br><span class="soft small">{escape(rest)}</span></div>'


def _row(claim: Claim, row: ResultByPreset) -> str:
    badges = "".join(_badge(preset, result) for preset, result in row.items())
    sentence = f"“{escape(claim.sentence)}” <span class='soft small'>{escape(_place(claim))}</span>"
    summary = f'<summary><div class="row"><span>{sentence}</span>{badges}</div></summary>'
    return f'<details id="{escape(claim.id)}">{summary}<div class="inside">{_inside(claim, row)}</div></details>'


def _place(claim: Claim) -> str:
    return f"§\u00a0{claim.where}" if claim.where[0].isdigit() else claim.where


def _badge(preset: str, result: ClaimResult) -> str:
    """Verdict, and below it the verdict for the other reading of the reference where it differs."""
    verdict, other = result.finding.verdict, result.unipolar
    differs = other is not None and other.verdict is not verdict
    note = f'<span class="other">0/1 mm: {escape(other.verdict.value)}</span>' if other and differs else ""
    return f'<span><span class="preset">{escape(preset)}</span>{page.badge(verdict.value)}{note}</span>'


def _inside(claim: Claim, row: ResultByPreset) -> str:
    whys = "".join(_why(preset, result.finding) for preset, result in row.items())
    others = "".join(_why(f"{preset}, 0/1 mm", r.unipolar) for preset, r in row.items() if r.unipolar)
    criterion = f"<span class='soft'>Reproduced if</span> {escape(claim.criterion)}.{_amended(claim)}"
    texts = f"<p>{criterion}</p><ul>{whys}{others}</ul>"
    findings = {preset: result.finding for preset, result in row.items()}
    findings |= {f"{preset}, 0/1 mm": r.unipolar for preset, r in row.items() if r.unipolar}
    return texts + _numbers(findings)


def _amended(claim: Claim) -> str:
    return f" <span class='soft'>(Amended: {escape(claim.amended)}.)</span>" if claim.amended else ""


def _why(name: str, finding: Finding) -> str:
    verdict = page.badge(finding.verdict.value)
    return f"<li><code>{escape(name)}</code> {verdict}: {escape(finding.why)}.</li>"


def _numbers(findings: Mapping[str, Finding]) -> str:
    """All values, one row each, one column per finding."""
    columns = {name: {(v.name, v.unit): v for v in finding.values} for name, finding in findings.items()}
    keys = list(dict.fromkeys(key for column in columns.values() for key in column))
    if not keys:
        return ""
    head = ["measured", *columns]
    return page.table(head, [[_name(*key), *(_format(c.get(key)) for c in columns.values())] for key in keys])


def _name(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _format(value: Value | None) -> str:
    """Format a number with four digits; a dash where there is none."""
    if value is None or not math.isfinite(value.number):
        return "–"
    return f"{value.number:.4g}"


def _figures(drawn: Sequence[DrawnFigure], preset: str) -> Iterator[str]:
    yield '<h2 id="figures">Figures</h2>'
    yield f"<p>The figures are drawn with the preset <code>{escape(preset)}</code>.</p>"
    yield from map(_figure, drawn)


def _beyond(drawn: Sequence[DrawnFigure], preset: str) -> Iterator[str]:
    """Yield the figures beyond the paper, with tables where they compare policies."""
    yield '<h2 id="beyond">Beyond the paper</h2>'
    yield (
        f"<p>This part is not in the paper and makes no claim about its numbers. Preset"
        f" <code>{escape(preset)}</code>.</p>"
    )
    for one in drawn:
        yield _figure(one)
        if one.outcomes:
            yield from policy_tables(one.outcomes)
    if any(one.outcomes for one in drawn):
        yield page.table(["Word", "Meaning"], policy_runs.DEFINITIONS.items(), stack=True)


def policy_tables(outcomes: Sequence[PolicyOutcome]) -> Iterator[str]:
    """Yield HTML tables: one for the whole runs, one for the steps."""
    yield page.table(HEADS, [_total_cells(one) for one in outcomes])
    ran = [one for one in outcomes if one.total is not None]
    yield "<p>Error left at the end of each step (mm); ✗: the step does not settle.</p>"
    yield page.table(("Step at (s)", "Gap (deg)", *(one.policy for one in ran)), _step_cells(ran))
    yield from (f"<p><code>{one.policy}</code>: {escape(one.refused)}.</p>" for one in outcomes if one.refused)


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


def _figure(one: DrawnFigure) -> str:
    return page.figure(one.vector, one.title, one.caption)


def _errata() -> Iterator[str]:
    yield '<h2 id="errata">Errata and decisions</h2>'
    names = ("id", "where", "problem", "decision")
    rows = [[erratum[name] for name in names] for erratum in errata()]
    yield page.table(["Erratum", "Where", "Problem", "Decision"], rows, stack=True)


def _how() -> Iterator[str]:
    yield '<h2 id="how">How it was measured</h2>'
    yield (
        "<p>The claims and their criteria were fixed before anything was measured. Where a criterion was changed"
        " after a first measurement, the claim states the reason.</p>"
    )
    yield page.table(["Word", "Meaning"], measures.DEFINITIONS.items(), stack=True)
    yield f'<p class="soft small">servotwin {escape(st.__version__)}</p>'
