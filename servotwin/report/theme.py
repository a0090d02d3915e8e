"""Colours and type of everything that is shown: figures, HTML reports and the dashboard."""

from __future__ import annotations

from importlib import resources
from typing import NamedTuple

OKABE_ITO = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7")
"""Colour-blind safe palette of figures on white: black, orange, sky blue, green, yellow, blue, red, pink."""
GREY, GRID = "#7F7F7F", "#DDDDDD"
"""Of figures: what lies behind, and the grid."""
FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'


class Shade(NamedTuple):
    """A colour of pages, on a light and on a dark ground."""

    light: str
    dark: str


# The colours of the palette, darker on white than in figures: words are written in them.
SHADES = {
    "ink": Shade("#1c1f23", "#e7eaee"),
    "soft": Shade("#56606b", "#a4aeb9"),
    "line": Shade("#dfe3e8", "#333a42"),
    "page": Shade("#ffffff", "#14171b"),
    "tint": Shade("#f5f7f9", "#1d2126"),
    "raised": Shade("#ffffff", "#1a1e23"),
    "blue": Shade("#0072b2", "#56b4e9"),
    "orange": Shade("#b06f00", "#e69f00"),
    "red": Shade("#b34700", "#ff9a5c"),
    "green": Shade("#00664b", "#3ccf9e"),
    "pink": Shade("#a14d7d", "#e3a3c6"),
    "grid": Shade("#e6e9ed", "#2b3138"),
    "focus": Shade("#005a92", "#8fd0ff"),
}
"""Colours of pages by their names in style sheets."""


def style_sheet(*, dark: bool) -> str:
    """Style sheet that reports and the dashboard begin with.

    Parameters
    ----------
    dark : bool
        Follow the reader's choice of a dark ground; reports, whose pictures are on white, stay light.
    """
    scheme = "light dark" if dark else "light"
    colours = "".join(
        f"  --{name}: {f'light-dark({shade.light}, {shade.dark})' if dark else shade.light};\n"
        for name, shade in SHADES.items()
    )
    common = resources.files("servotwin.report").joinpath("common.css").read_text(encoding="utf-8")
    return f":root {{\n  color-scheme: {scheme};\n{colours}  font: 16px/1.45 {FONT};\n}}\n{common}"
