"""Self-contained HTML: one file with its style and images inside, nothing fetched from anywhere."""

from __future__ import annotations

from markupsafe import Markup

from servotwin.report.theme import style_sheet
from servotwin.runtime.templates import render


def page(template: str, title: str, **values: object) -> str:
    """Compose a page.

    Parameters
    ----------
    template : str
        File in ``servotwin/templates`` that extends ``report.html``.
    title : str
        Of the window.
    **values : object
        By the names that the template uses.
    """
    return render(template, title=title, theme=Markup(style_sheet(dark=False)), **values)
