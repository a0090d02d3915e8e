"""Tables that readers give and writers take: named columns of numbers, and metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from servotwin.plant.signals import Array


class LogColumns(NamedTuple):
    """Requested columns as the file holds them.

    Attributes
    ----------
    values : mapping
        By name; where the file has text in place of a number, NaN.
    names : sequence of str
        Of all columns.
    metadata : mapping
    damaged : mapping
        The first cell of a column that is no number, in words.
    ends_within_line : bool
        A text without the end of its last line, as a file has that was cut off.
    """

    values: Mapping[str, Any]
    names: Sequence[str]
    metadata: Mapping[str, Any]
    damaged: Mapping[str, str] = {}
    ends_within_line: bool = False


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Columns of equal length with their units in their names, and metadata of the run."""

    columns: Mapping[str, Array]
    metadata: Mapping[str, Any]


def parsed(text: str) -> Mapping[str, Any]:
    """Parse metadata as JSON; a comment of another kind holds none."""
    try:
        metadata = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return metadata if isinstance(metadata, dict) else {}
