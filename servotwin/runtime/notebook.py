"""Tables for notebooks."""

from __future__ import annotations

from collections.abc import Mapping

from servotwin.runtime.templates import render


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """Make an HTML table of names and values, as ``_repr_html_`` returns it."""
    return render("notebook_table.html", title=title, rows=rows)
