"""The page's own files, read once: content type, digest and compressed body of each."""

from __future__ import annotations

import gzip
import hashlib
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

from servotwin.report.theme import style_sheet

INDEX = "index.html"
_THEME = "theme.css"
SECURITY = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "worker-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
"""Headers of every file: no script but the page's own files, nothing from elsewhere, in no frame."""
REPORT_SECURITY = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
"""Headers of a report, whose style is inside it."""
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


class Asset(NamedTuple):
    """A file of the page; `tag`: its entity tag."""

    content_type: str
    body: bytes
    compressed: bytes
    tag: str


@lru_cache(maxsize=1)
def assets() -> dict[str, Asset]:
    """Files by name."""
    bodies = {
        file.name: file.read_bytes() for file in resources.files("servotwin.dashboard").joinpath("static").iterdir()
    }
    bodies[_THEME] = style_sheet(dark=True).encode()
    return {name: _asset(kind, body) for name, body in bodies.items() if (kind := _TYPES.get(_suffix(name)))}


def _asset(content_type: str, body: bytes) -> Asset:
    tag = '"' + hashlib.sha256(body).hexdigest()[:32] + '"'
    return Asset(content_type, body, gzip.compress(body, 9, mtime=0), tag)


def _suffix(name: str) -> str:
    return name[name.rfind(".") :]
