"""Tables that readers give and writers take: named columns of numbers, and metadata."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_MOST_ROWS = 64  # of a matrix, each of which is a column


Requested = Collection[str] | Callable[[Sequence[str]], Collection[str]]
"""Names of the columns that are wanted, or a choice of them, made among the names of all columns of the file."""


def among(requested: Requested, names: Sequence[str]) -> Collection[str]:
    """Names of the wanted columns of a file that has columns of these names."""
    return requested(names) if callable(requested) else requested


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


class ColumnPlace(NamedTuple):
    """Place of a column in a file of arrays: an array's name, and its field, or its row or column."""

    array: str
    field: str | None = None
    row: int | None = None
    flat: bool = False

    def of(self, array: Any) -> Any:
        """(n,) values of the column."""
        values = np.squeeze(np.asarray(array[self.field] if self.field is not None else array))
        if self.row is not None:
            return values[self.row] if self.flat else values[:, self.row]
        return np.ravel(values)


def places_of(name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, ColumnPlace]:
    """Columns of an array: itself, `name/field` of records, or `name[i]`, counted from 0, of a matrix's rows."""
    sizes = tuple(size for size in shape if size != 1)
    if dtype.names and len(sizes) == 1:
        return {f"{name}/{field}".lstrip("/"): ColumnPlace(name, field) for field in dtype.names}
    if len(sizes) == 1 and dtype.kind != "V":
        return {name: ColumnPlace(name)}
    if len(sizes) == 2 and min(sizes) <= _MOST_ROWS and dtype.kind in "fiu":
        return {f"{name}[{i}]": ColumnPlace(name, None, i, sizes[0] < sizes[1]) for i in range(min(sizes))}
    return {}
