"""Self-contained HTML: one file with its style and images inside, nothing fetched from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from string import Template

_SIGNS = {"reproduced": ("✓", "yes"), "not as stated": ("✗", "no"), "cannot be checked": ("–", "open")}


def page(title: str, body: Iterable[str]) -> str:
    """Compose the document around a body of HTML fragments."""
    text = resources.files("servotwin.report").joinpath("page.html").read_text(encoding="utf-8")
    return Template(text).substitute(title=escape(title), body="\n".join(body))


def image(vector: bytes, text: str) -> str:
    """Make an image element of an SVG; `text` is its alternative text."""
    data = base64.b64encode(vector).decode("ascii")
    return f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(text)}">'


def figure(vector: bytes, title: str, caption: str) -> str:
    """Make a figure of an image with title and caption."""
    text = f"<strong>{escape(title)}</strong> {escape(caption)}"
    return f"<figure><div class='scroll'>{image(vector, title)}</div><figcaption>{text}</figcaption></figure>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, stack: bool = False) -> str:
    """Make a table of plain texts; `stack` turns rows into cards on a narrow screen, otherwise the table scrolls."""
    cells = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = "".join(_row(head, row) for row in rows)
    kind = ' class="stack"' if stack else ""
    return f'<div class="scroll"><table{kind}><thead><tr>{cells}</tr></thead><tbody>{lines}</tbody></table></div>'


def badge(verdict: str) -> str:
    """Make a badge of a verdict: sign, word and colour."""
    sign, kind = _SIGNS[verdict]
    return f'<span class="badge {kind}">{sign} {escape(verdict)}</span>'


def _row(head: Sequence[str], row: Sequence[str]) -> str:
    pairs = zip(head, row, strict=True)
    return "<tr>" + "".join(f'<td data-label="{escape(name)}">{escape(cell)}</td>' for name, cell in pairs) + "</tr>"
