"""Enrolment of many servos from a CSV file: all of its rows, or none."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from servotwin.config.named_file import check_named
from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.runtime.signals import end_signals
from servotwin.twin_service.auth import Verifiers, write_private, write_tokens
from servotwin.twin_service.twin_file import read_twin
from servotwin.up.enrolment import (
    CERTIFICATE,
    CONFIG,
    TOKEN,
    Enroller,
    Enrolment,
    StatedNoise,
    drive_of,
    open_tokens,
    present_tokens,
)

_ALL = 20
"""Bad rows that one message lists."""


def _noise(unit: str) -> Callable[[str], StatedNoise]:
    parse = _number(f"noise_{unit}", f"{unit} rms", above=False)
    return lambda text: StatedNoise(parse(text), unit)


def _number(column: str, unit: str, above: bool) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not (value > 0.0 if above else value >= 0.0) or value == float("inf"):
            allowed = "above 0" if above else "of 0 or more"
            raise InvalidInput(f"{column} = {text[:80]!r}: give a number {allowed}, in {unit}")
        return value

    return parse


def read_enrolments(path: Path, defaults: Enrolment) -> dict[int, Enrolment]:
    """Read the requests in a CSV file; its first line names the columns, of which only `name` is required.

    Parameters
    ----------
    path : Path
        Paths in it are relative to its folder.
    defaults : Enrolment
        Values of columns that are absent, and of empty cells.

    Returns
    -------
    dict of int to Enrolment
        By the number of the row's line.

    Raises
    ------
    InvalidInput
        The file cannot be read, or some rows are not allowed: one sentence for each, with its line.
    """
    columns = _columns(path.parent)
    check_named(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            head = [cell.strip() for cell in next(reader, [])]
            _check_head(path, head, list(columns))
            requests, faults = dict[int, Enrolment](), dict[int, str]()
            for row in reader:
                if not any(cell.strip() for cell in row):
                    continue
                line = reader.line_num
                with _collected(faults, line):
                    requests[line] = _request(head, row, columns, path.parent, defaults)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{path}: cannot be read as CSV in UTF-8 ({why})") from None
    for line, fault in _repeated(requests):
        faults.setdefault(line, fault)
    _require_none(path, faults)
    if not requests:
        raise InvalidInput(f"{path}: has no rows; each row enrolls a servo")
    return requests


def enroll_all(twin_path: Path, source: Path, requests: Mapping[int, Enrolment]) -> list[Path]:
    """Enrol all servos with the twin of a file, and return the files that were written.

    Every row is checked before anything is written. The tokens become valid together, at the end; where a file cannot
    be written, or a signal ends the command, all folders are left as they were. The file of tokens is locked while the
    folders are written only.

    Parameters
    ----------
    twin_path, source : Path
        The twin's file; the file that the requests are from, for messages.
    requests : mapping of int to Enrolment
        By line.

    Raises
    ------
    InvalidInput
        Some rows are not allowed: one sentence for each, with its line; or a file cannot be written.
    """
    with end_signals() as signals, _progress() as progress:
        twin = read_twin(twin_path)
        rows = _Rows(Enroller(twin), source, requests, progress)
        rows.check(present_tokens(twin), "checking")
        with open_tokens(twin) as (tokens, known):
            rows.check(known, "checking again")  # others may have enrolled meanwhile
            with _all_or_nothing(requests.values()):
                written, verifiers = rows.write()
                os.sync()  # once for all, which is quicker: an edge has its token before the twin knows it
                signals.ignore()
                write_tokens(tokens, replace(known, servos={**known.servos, **verifiers}))
    return [*written, tokens]


class _Rows:
    """Requests of a file, with the texts of their edge.toml once they are checked."""

    def __init__(self, enroller: Enroller, source: Path, requests: Mapping[int, Enrolment], progress: Progress) -> None:
        self._enroller, self._source, self._requests, self._progress = enroller, source, requests, progress
        self._texts = dict[int, str]()

    def check(self, known: Verifiers, doing: str) -> None:
        """Check all rows, and make the texts that are not made; raises InvalidInput."""
        faults = dict[int, str]()
        for line, request in self._each(doing):
            with _collected(faults, line):
                self._texts[line] = self._enroller.text(request, known, self._texts.get(line, ""))
        _require_none(self._source, faults)

    def write(self) -> tuple[list[Path], dict[str, bytes]]:
        """Write all folders; return the files, and the tokens' verifiers by servo. Raises InvalidInput."""
        written, verifiers = list[Path](), dict[str, bytes]()
        for line, request in self._each("writing"):
            try:
                files, verifiers[request.servo] = self._enroller.write(request, self._texts[line], durable=False)
            except (InvalidInput, OSError) as error:
                _require_none(self._source, {line: str(error)})
                raise
            written += files
        return written, verifiers

    def _each(self, doing: str) -> Iterable[tuple[int, Enrolment]]:
        return self._progress.track(self._requests.items(), total=len(self._requests), description=doing)


def _progress() -> Progress:
    """A bar on the standard error that disappears in the end; none where that is no terminal."""
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


_Column = Callable[[str], object]


def _columns(folder: Path) -> dict[str, tuple[str, _Column]]:
    """Field of a request, and parser, for each column."""
    return {
        "name": ("servo", str),
        "edge": ("folder", lambda text: folder / text),
        "role": ("role", str),
        "sample_rate_hz": ("sample_rate", _number("sample_rate_hz", "Hz", above=True)),
        "drive": ("drive", cache(lambda text: drive_of(folder / text))),
        "url": ("url", str),
        "noise_um": ("noise", _noise("um")),
        "noise_mdeg": ("noise", _noise("mdeg")),
        "ca": ("ca", lambda text: folder / text),
    }


def _check_head(path: Path, head: list[str], columns: list[str]) -> None:
    allowed = f"the first line names the columns: {', '.join(columns)}"
    for name in head:
        if any(separator in name for separator in (";", "\t")):
            raise InvalidInput(f"{path}: line 1: separates its columns by semicolons or tabs; separate them by commas")
        if name not in columns:
            raise InvalidInput(
                f"{path}: line 1: column {name[:80]!r} is not known{did_you_mean(name, columns)}; {allowed}"
            )
    if len(set(head)) < len(head) or "name" not in head:
        raise InvalidInput(f"{path}: line 1: column 'name' is missing, or a column is named twice; {allowed}")


def _request(
    head: list[str], row: list[str], columns: Mapping[str, tuple[str, _Column]], folder: Path, defaults: Enrolment
) -> Enrolment:
    if len(row) != len(head):
        raise InvalidInput(f"has {len(row)} cells; line 1 names {len(head)} columns")
    cells = {name: cell.strip() for name, cell in zip(head, row, strict=True) if cell.strip()}
    for name, cell in cells.items():
        if "\0" in cell:  # no path may hold one
            raise InvalidInput(f"{name} = {cell[:80]!r}: has a zero byte; the file is damaged, or no text")
    if "name" not in cells:
        raise InvalidInput("has no name")
    values = {columns[name][0]: columns[name][1](cell) for name, cell in cells.items()}
    return replace(defaults, **{"folder": folder / cells["name"], **values})  # type: ignore[arg-type]


def _repeated(requests: Mapping[int, Enrolment]) -> Iterator[tuple[int, str]]:
    """Rows whose name or folder an earlier row has."""
    names, folders = dict[str, int](), dict[Path, int]()
    for line, request in requests.items():
        if (first := names.setdefault(request.servo, line)) != line:
            yield line, f"name {request.servo[:80]!r}: line {first} has it already"
        elif (first := folders.setdefault(request.folder.resolve(), line)) != line:
            yield line, f"edge {request.folder}: line {first} has that folder already"


@contextmanager
def _collected(faults: dict[int, str], line: int) -> Iterator[None]:
    """Note the fault of a row, and go on with the next one."""
    try:
        yield
    except InvalidInput as error:
        faults[line] = str(error)


def _require_none(path: Path, faults: Mapping[int, str]) -> None:
    if not faults:
        return
    said = [f"line {line}: {fault}" for line, fault in sorted(faults.items())]
    more = [f"and {len(said) - _ALL} more"] if len(said) > _ALL else []
    rows = "1 row is" if len(said) == 1 else f"{len(said)} rows are"
    raise InvalidInput("\n".join([f"{path}: {rows} not allowed, and no servo was enrolled:", *said[:_ALL], *more]))


@contextmanager
def _all_or_nothing(requests: Iterable[Enrolment]) -> Iterator[None]:
    """Leave the folders of all requests as they were where the block fails."""
    before = {request.folder: _contents(request.folder) for request in requests}
    missing = {parent for folder in before for parent in folder.parents if not parent.exists()}
    try:
        yield
    except BaseException:
        for folder, contents in before.items():
            with suppress(OSError, InvalidInput):
                _put_back(folder, contents)
        for parent in sorted(missing, key=lambda path: len(path.parts), reverse=True):
            with suppress(OSError):
                parent.rmdir()
        raise


def _contents(folder: Path) -> dict[str, bytes | None] | None:
    """Files that an enrolment writes, as they are, None for one that is missing; None: there is no such folder."""
    if not folder.exists():
        return None
    files = {name: folder / name for name in (CONFIG, TOKEN, CERTIFICATE)}
    return {name: file.read_bytes() if file.is_file() else None for name, file in files.items()}


def _put_back(folder: Path, contents: Mapping[str, bytes | None] | None) -> None:
    for name in (CONFIG, TOKEN, CERTIFICATE):
        if contents is None or contents[name] is None:
            (folder / name).unlink(missing_ok=True)
    if contents is None:
        folder.rmdir()
    elif (token := contents[TOKEN]) is not None:
        write_private(folder / TOKEN, token.decode())
