"""Text tables: any separator, decimal comma, comment lines, units in the header; cells without a number are told."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns, Requested, SignalTable, among, parsed
from servotwin.logs.dates import time_of
from servotwin.plant.signals import Array

_ROWS = 100_000  # read or written at a time
_SAMPLE = 65536  # bytes from which the encoding is guessed
_LOOKED_AT = 40  # lines from which the layout is guessed
_METADATA = "metadata"  # name of a CSV file's last column; its first row holds the metadata as JSON
_COMMENTS = ("#", "%", "//")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?$")
_THOUSANDS_OR_DECIMALS = re.compile(r"[+-]?[1-9]\d{0,2}(\.\d{3})+$")
_POINT = re.compile(r"[+-]?\d*\.\d*(e[+-]?\d+)?$", re.IGNORECASE)
_COMMA = re.compile(r"(^|[^\d.,])[+-]?(\d+|\d{1,3}(\.\d{3})+),\d+($|[^\d.,])")
_LONGEST_CELL = 2**31 - 1
"""Characters: the metadata of a log, with its scenario, are one cell; Python's own limit is 131072."""
_GZIP = b"\x1f\x8b"
_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}


class _Layout(NamedTuple):
    """Layout of a text table.

    Attributes
    ----------
    encoding : str
    separator : str or None
        None: any white space.
    decimal_comma : bool
    names : tuple of str
    named : bool
        False: the table has no line of names, and they are made up.
    first : int
        Lines before the first row of numbers.
    metadata : mapping
    """

    encoding: str
    separator: str | None
    decimal_comma: bool
    names: tuple[str, ...]
    named: bool
    first: int
    metadata: Mapping[str, Any]


def read_csv(path: Path, requested: Requested) -> LogColumns:
    """Read the requested columns whole, as `csv_blocks` reads them in parts."""
    blocks = list(csv_blocks(path, requested))
    first = blocks[0]
    values = {name: np.concatenate([each.values[name] for each in blocks]) for name in first.values}
    damaged = {name: text for each in reversed(blocks) for name, text in each.damaged.items()}
    return LogColumns(values, first.names, first.metadata, damaged, blocks[-1].ends_within_line)


def csv_blocks(path: Path, requested: Requested) -> Iterator[LogColumns]:
    """Read the requested columns in blocks of rows, at least one; a cell that is no number becomes NaN.

    Each block describes the first such cell of each column. The metadata are JSON in the first row of a last column
    "metadata", so that other programs read the table as it is. In files of earlier versions they are a first line that
    begins with #.
    """
    layout = _layout(path)
    requested = among(requested, layout.names)
    wanted = [name for name in layout.names if name in requested]
    metadata = layout.metadata
    with path.open(encoding=layout.encoding, errors="replace") as file:
        for _ in islice(file, layout.first):
            pass
        if not metadata and layout.names and layout.names[-1] == _METADATA:
            metadata = _first_metadata(path, layout)
        if not wanted and requested and not layout.named:
            raise InvalidInput(
                f"log {path}: line 1 must name the columns ({next(iter(requested))}, ...); without names they are "
                f"called {', '.join(layout.names[:8])}"
            )
        if not wanted:
            yield LogColumns({}, layout.names, metadata)
            return
        if doubled := [name for name in requested if layout.names.count(name) > 1]:
            raise InvalidInput(
                f"log {path}: {layout.names.count(doubled[0])} columns are named {doubled[0]!r}, as where two machines "
                "are in one file: give each its own name"
            )
        places = [layout.names.index(name) for name in wanted]
        unclear = set(places) if layout.decimal_comma else set()
        for number, lines in _blocks(file, layout.first + 1):
            _check_points(path, layout, unclear, lines, number)
            values, damaged = _values(lines, layout, places, number)
            texts = {wanted[place]: text for place, text in damaged.items()}
            cut = bool(lines) and not lines[-1].endswith("\n")
            yield LogColumns(dict(zip(wanted, values.T, strict=True)), layout.names, metadata, texts, cut)


def _layout(path: Path) -> _Layout:
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace") as file:
        lines = [line.rstrip("\r\n") for line in islice(file, 4 * _LOOKED_AT)]
    metadata = parsed(lines[0].removeprefix("#")) if lines and lines[0].startswith("#") else {}
    kept = [(place, line) for place, line in enumerate(lines) if line.strip() and not line.startswith(_COMMENTS)]
    if not kept:
        raise InvalidInput(f"log {path}: line 1 must name the columns; the file holds no row")
    separator = _separator([line for _, line in kept[1:_LOOKED_AT]] or [kept[0][1]])
    rows = [_cells(line, separator) for _, line in kept]
    comma = _decimal_comma([cell for cells in rows[1:_LOOKED_AT] for cell in cells], separator)
    size = _usual_size(rows[1:_LOOKED_AT] or rows)
    first = next((i for i, cells in enumerate(rows) if _numeric(cells[:size], comma)), len(rows))
    # Above the names there may be prose.
    if first == len(rows) and len(rows) > 2:
        raise InvalidInput(_no_numbers(path, kept[1:], rows[1:], size))
    above = rows[:first]
    # Without one of the rows' size the last longer line names them, as where rows leave out a last comment.
    longer = [cells[:size] for cells in above if len(cells) > size > 1][-1:]
    heads = [cells for cells in above if len(cells) == size] or longer or above[:1]
    names = heads[0] if heads else [f"col{i + 1}" for i in range(size)]
    if separator == "," and first < len(rows) and 1 < len(names) < _filled(rows[first]):
        raise InvalidInput(
            f"log {path}: line {kept[first][0] + 1}: {_filled(rows[first])} values for {len(names)} names, all between "
            "commas: if numbers have decimal commas, separate the columns by semicolons or tabs"
        )
    if len(heads) > 1 and len(heads[1]) == len(names):
        names = [_with_unit(name, unit) for name, unit in zip(names, heads[1], strict=True)]
    last = kept[first][0] if first < len(kept) else len(lines)
    return _Layout(encoding, separator, comma, tuple(names), bool(heads), last, metadata)


def _filled(cells: Sequence[str]) -> int:
    """Cells up to the last that is not empty: rows may end with a separator."""
    return max((place for place, cell in enumerate(cells, 1) if cell), default=0)


def _decimal_comma(cells: Sequence[str], separator: str | None) -> bool:
    """True where numbers have decimal commas: not where all commas may part thousands, and points part decimals or
    commas part columns."""
    commas = [cell for cell in cells if _COMMA.match(cell)]
    if any(not _THOUSANDS.match(cell) for cell in commas):
        return True
    points = any(_POINT.match(cell) and not _THOUSANDS_OR_DECIMALS.match(cell) for cell in cells)
    return bool(commas) and separator != "," and not points


def _no_numbers(path: Path, kept: Sequence[tuple[int, str]], rows: Sequence[Sequence[str]], size: int) -> str:
    """Sentence on a table without a row of numbers, with the first cell that begins as one does."""
    for (line, _), cells in zip(kept, rows, strict=True):
        begun = next((cell for cell in cells if re.match(r"[+-]?[.,]?\d", cell) and _number(cell, True) is None), None)
        if len(cells) == size and begun is not None:
            return (
                f"log {path}: line {line + 1}: {begun[:30]!r} is no number: write numbers, or dates such as 2026-03-01 "
                "08:00:00, and the units in the header"
            )
    return f"log {path}: none of its first lines is a row of numbers: is it a table of samples?"


def _encoding(path: Path) -> str:
    """UTF-8, UTF-16 by its mark or its zeros, or Latin-1, in which older programs write degrees and micrometres."""
    with path.open("rb") as file:
        begin = file.read(_SAMPLE)
    for mark, name in _BYTE_ORDER_MARKS.items():
        if begin.startswith(mark):
            return name
    if begin[1::2].count(0) > len(begin) // 4 > begin[::2].count(0):
        return "utf-16-le"
    if any(byte < 9 or 13 < byte < 32 for byte in begin):
        place = next(i for i, byte in enumerate(begin) if byte < 9 or 13 < byte < 32)
        packed = "; it is packed by gzip: unpack it first" if begin.startswith(_GZIP) else ""
        raise InvalidInput(f"log {path}: is not a text file (byte {place} is binary data){packed}")
    try:
        begin.decode("utf-8")
    except UnicodeDecodeError as error:
        # The sample may end within a character.
        return "utf-8" if error.start >= len(begin) - 3 else "latin-1"
    return "utf-8"


def _usual_size(rows: Sequence[Sequence[str]]) -> int:
    counts = [len(cells) for cells in rows]
    return max(set(counts), key=counts.count)


def _with_unit(name: str, unit: str) -> str:
    bare = unit.strip("[]()")
    return f"{name} [{bare}]" if bare else name


def _separator(lines: Sequence[str]) -> str | None:
    """The separator with which most lines have the same number of cells, more than one."""
    best: str | None = ","
    score = 0
    for separator in ("\t", ";", ",", "|", None):
        counts = [len(_cells(line, separator)) for line in lines]
        usual = max(set(counts), key=counts.count)
        # Among equals the earlier: a comma inside a row with semicolons is a decimal one.
        if usual > 1 and counts.count(usual) > score:
            best, score = separator, counts.count(usual)
    return best


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is not None and '"' in line:
        csv.field_size_limit(_LONGEST_CELL)
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    return [cell.strip() for cell in line.split(separator)]


def _numeric(cells: Sequence[str], comma: bool) -> bool:
    """True for a row of which the first cell is a number or a date, and half of all."""
    good = [_number(cell, comma) is not None for cell in cells if cell]
    return bool(good) and good[0] and 2 * sum(good) >= len(good)


def _number(cell: str, comma: bool) -> float | None:
    """The number, date or time of day (s) that a cell holds."""
    text = cell.replace(".", "").replace(",", ".") if comma and "," in cell else cell
    try:
        return float(text)
    except ValueError:
        pass
    if _THOUSANDS.match(cell):
        return float(cell.replace(",", ""))
    return time_of(cell)


def _values(
    lines: Sequence[str], layout: _Layout, places: Sequence[int], line_number: int
) -> tuple[Array, dict[int, str]]:
    """(n, c) numbers, and in words the first cell of each column that is none."""
    try:
        return _numbers(lines, layout, places), {}
    except ValueError:
        pass
    # A comment, or a cell that is no number: no line is looked at before that.
    kept = [(line_number + row, line) for row, line in enumerate(lines) if _is_row(line)]
    if len(kept) < len(lines):
        try:
            return _numbers([line for _, line in kept], layout, places), {}
        except ValueError:
            pass
    return _patiently(kept, layout, places)


def _numbers(lines: Sequence[str], layout: _Layout, places: Sequence[int]) -> Array:
    if all(map(str.isspace, lines)):
        return np.empty((0, len(places)))
    text = [line.replace(",", ".") for line in lines] if layout.decimal_comma else lines
    return np.loadtxt(text, delimiter=layout.separator, usecols=places, ndmin=2, comments=None)


def _is_row(line: str) -> bool:
    return not line.isspace() and not line.startswith(_COMMENTS)


def _blocks(file: IO[str], line_number: int) -> Iterator[tuple[int, list[str]]]:
    """Lines with the number of the first, at least one block."""
    lines = list(islice(file, _ROWS))
    yield line_number, lines
    while lines:
        line_number += len(lines)
        lines = list(islice(file, _ROWS))
        if lines:
            yield line_number, lines


def _check_points(path: Path, layout: _Layout, unclear: set[int], lines: Sequence[str], line_number: int) -> None:
    """Refuse a column in which every point may part thousands, among decimal commas; those with another are taken from
    the `unclear` ones."""
    doubtful: dict[int, str] = {}
    rows = [(number, line) for number, line in enumerate(lines, line_number) if "." in line] if unclear else []
    for number, line in rows:
        cells = _cells(line, layout.separator)
        for place in unclear & set(range(len(cells))):
            if _THOUSANDS_OR_DECIMALS.match(cells[place]):
                doubtful.setdefault(place, f"line {number}: column {layout.names[place]!r}, {cells[place]!r}")
            elif "." in cells[place]:
                unclear.discard(place)
        if not unclear:
            return
    for place in sorted(unclear & doubtful.keys()):
        raise InvalidInput(
            f"log {path}: {doubtful[place]}: the point may part thousands or decimals: the other numbers have decimal "
            "commas; write this column without thousands separators"
        )


def _patiently(
    lines: Sequence[tuple[int, str]], layout: _Layout, places: Sequence[int]
) -> tuple[Array, dict[int, str]]:
    """As `_values`, cell by cell; `lines` with their numbers."""
    damaged: dict[int, str] = {}
    result = np.full((len(lines), len(places)), np.nan)
    for row, (number, text) in enumerate(lines):
        cells = _cells(text, layout.separator)
        for column, place in enumerate(places):
            cell = cells[place] if place < len(cells) else ""
            value = _number(cell, layout.decimal_comma)
            if value is None:
                damaged.setdefault(column, f"line {number}: {cell[:30]!r}")
            else:
                result[row, column] = value
    return result, damaged


def _first_metadata(path: Path, layout: _Layout) -> Mapping[str, Any]:
    with path.open(encoding=layout.encoding, errors="replace") as file:
        line = next(islice(file, layout.first, None), "")
    quoted = line.partition(',"')[2].rstrip().removesuffix('"')
    return parsed(quoted.replace('""', '"'))


def write_csv(table: SignalTable, path: Path) -> None:
    """Write a line of names, then numbers; the metadata are in the first row of a last column."""
    values = np.column_stack(list(table.columns.values()))
    names, end = list(table.columns), "\n"
    if table.metadata:
        names, end = [*names, _METADATA], ",\n"
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"{','.join(names)}\n")
        if table.metadata and len(values):
            np.savetxt(file, values[:1], fmt="%.12g", delimiter=",", newline=",")
            quoted = json.dumps(table.metadata).replace('"', '""')
            file.write(f'"{quoted}"\n')
            values = values[1:]
        for first in range(0, len(values), _ROWS):
            np.savetxt(file, values[first : first + _ROWS], fmt="%.12g", delimiter=",", newline=end)
