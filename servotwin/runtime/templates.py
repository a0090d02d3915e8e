"""Pages, tables and drawings from templates, which escape every value."""

from __future__ import annotations

import base64
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment


def render(name: str, **values: object) -> str:
    """Fill a template.

    Parameters
    ----------
    name : str
        File in ``servotwin/templates``.
    **values : object
        By the names that the template uses; a missing one is an error.
    """
    return _environment().get_template(name).render(values)


@lru_cache(maxsize=1)
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # 30 ms, which only those pay who write a page

    made = Environment(
        loader=PackageLoader("servotwin"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["data_uri"] = _data_uri
    return made


def _data_uri(vector: bytes) -> str:
    """An SVG as the address of an image that needs no file."""
    return f"data:image/svg+xml;base64,{base64.b64encode(vector).decode('ascii')}"
