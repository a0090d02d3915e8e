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
from servotwin.reproduction import chapter, figures
from servotwin.reproduction.claims import Claim, Finding, Result, Value, Verdict
from servotwin.reproduction.document import DEFINITIONS, PAPER, by_claim
from servotwin.reproduction.tasks import Drawn, plate

Row = Mapping[str, Result]
TITLE = "servotwin: the paper, claim by claim"


def report(results: Sequence[Result], drawn: Sequence[Drawn], preset: str) -> str:
    """The page as HTML; sections without content are left out."""
    rows = by_claim(results)
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
    """The errata in our own words: id, where, problem, decision."""
    text = resources.files("servotwin.reproduction").joinpath("errata.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["erratum"])


def _head(rows: Mapping[Claim, Row], drawn: Sequence[Drawn]) -> Iterator[str]:
    yield f"<h1>{escape(TITLE)}</h1>"
    yield f"<p>What {escape(PAPER)} says, beside what this package measures by running the code.</p>"
    links = [
        ("claims", "Claims", rows),
        ("figures", "Figures", split(drawn)[0]),
        ("beyond", "Beyond the paper", split(drawn)[1]),
        ("errata", "Errata", True),
        ("how", "How", True),
    ]
    yield "<nav>" + "".join(f'<a href="#{name}">{text}</a>' for name, text, there in links if there) + "</nav>"


def _claims(rows: Mapping[Claim, Row]) -> Iterator[str]:
    presets = list(next(iter(rows.values())))
    yield '<h2 id="claims">Verdicts</h2>'
    yield _summary(rows, presets)
    yield (
        "<p>The printed gains and the printed table do not belong together (erratum E1), so every claim is measured in"
        " three presets: <code>paper</code> has the pitch doubled, <code>table1</code> is as printed,"
        " <code>paper-gain2</code> has the gains doubled. The sentences are the paper's, some"
        " of them shortened. Open a row for the criterion and the numbers.</p>"
    )
    heads = "".join(f"<span>{escape(preset)}</span>" for preset in presets)
    yield f'<div class="claims"><div class="row head"><span>Claim</span>{heads}</div>'
    yield from (_row(claim, row) for claim, row in rows.items())
    yield "</div>"


def _summary(rows: Mapping[Claim, Row], presets: Sequence[str]) -> str:
    cards = "".join(_card(preset, [row[preset].finding.verdict for row in rows.values()]) for preset in presets)
    return f'<div class="sum">{cards}</div>'


def _card(preset: str, verdicts: Sequence[Verdict]) -> str:
    counts = Counter(verdicts)
    total = f"<strong>{counts[Verdict.REPRODUCED]} of {len(verdicts)}</strong> reproduced"
    rest = ", ".join(f"{counts[v]} {v.value}" for v in list(Verdict)[1:] if counts[v])
    return f'<div><code>{escape(preset)}</code><br>{total}<br><span class="soft small">{escape(rest)}</span></div>'


def _row(claim: Claim, row: Row) -> str:
    badges = "".join(_badge(preset, result) for preset, result in row.items())
    sentence = f"“{escape(claim.sentence)}” <span class='soft small'>{escape(_place(claim))}</span>"
    summary = f'<summary><div class="row"><span>{sentence}</span>{badges}</div></summary>'
    return f'<details id="{escape(claim.id)}">{summary}<div class="inside">{_inside(claim, row)}</div></details>'


def _place(claim: Claim) -> str:
    return f"§\u00a0{claim.where}" if claim.where[0].isdigit() else claim.where


def _badge(preset: str, result: Result) -> str:
    """The verdict, and below it that of the other reading of the reference where it differs."""
    verdict, other = result.finding.verdict, result.unipolar
    differs = other is not None and other.verdict is not verdict
    note = f'<span class="other">0/1 mm: {escape(other.verdict.value)}</span>' if other and differs else ""
    return f'<span><span class="preset">{escape(preset)}</span>{page.badge(verdict.value)}{note}</span>'


def _inside(claim: Claim, row: Row) -> str:
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
    return page.table(head, [[_name(*key), *(shown(c.get(key)) for c in columns.values())] for key in keys])


def _name(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def shown(value: Value | None) -> str:
    """A number for people: four digits; a dash where there is none."""
    if value is None or not math.isfinite(value.number):
        return "–"
    return f"{value.number:.4g}"


def _figures(drawn: Sequence[Drawn], preset: str) -> Iterator[str]:
    yield '<h2 id="figures">Figures</h2>'
    yield f"<p>Drawn with the preset <code>{escape(preset)}</code>.</p>"
    yield from map(_figure, drawn)


def _beyond(drawn: Sequence[Drawn], preset: str) -> Iterator[str]:
    """Our own figures, with a table where they compare policies."""
    yield '<h2 id="beyond">Beyond the paper</h2>'
    yield (
        f"<p>None of this is in the paper, and nothing here is a claim about its numbers. Preset"
        f" <code>{escape(preset)}</code>.</p>"
    )
    for one in drawn:
        yield _figure(one)
        if one.outcomes:
            yield from chapter.tables(one.outcomes)
    if any(one.outcomes for one in drawn):
        yield page.table(["Word", "Meaning"], [[word, text] for word, text in chapter.words().items()], stack=True)


def split(drawn: Sequence[Drawn]) -> tuple[list[Drawn], list[Drawn]]:
    """The paper's figures, and ours."""
    ours = {one.name for one in figures.OURS}
    return [one for one in drawn if one.name not in ours], [one for one in drawn if one.name in ours]


def _figure(one: Drawn) -> str:
    shape = plate(one.name)
    return page.figure(one.vector, shape.title, shape.caption)


def _errata() -> Iterator[str]:
    yield '<h2 id="errata">Errata and decisions</h2>'
    names = ("id", "where", "problem", "decision")
    rows = [[erratum[name] for name in names] for erratum in errata()]
    yield page.table(["", "Where", "What is wrong or open", "What we do"], rows, stack=True)


def _how() -> Iterator[str]:
    yield '<h2 id="how">How it was measured</h2>'
    yield (
        "<p>The claims and their criteria were fixed before anything was measured. The few criteria that were changed"
        " after a first measurement say so, and why.</p>"
    )
    yield page.table(["Word", "Meaning"], [[word, text] for word, text in DEFINITIONS.items()], stack=True)
    yield f'<p class="soft small">servotwin {escape(st.__version__)}</p>'
