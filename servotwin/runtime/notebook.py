"""Tables for notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """Make an HTML table of names and values, as ``_repr_html_`` returns it."""
    cell = "<td style='text-align:left'>{}</td>"
    lines = "".join(f"<tr>{cell.format(escape(k))}{cell.format(escape(v))}</tr>" for k, v in rows.items())
    head = f"<tr><th colspan='2' style='text-align:left'>{escape(title)}</th></tr>"
    return f"<table>{head}{lines}</table>"
