"""Long benchmarks in pieces: each piece goes into a file as it comes, and a run that is begun again does the rest.

``python -m benchmarks.batch loops --jobs 16 --seconds 500 --seed 5 --count 200 loops.jsonl`` runs for 500 s and shows
what the file holds so far; the same command goes on from there. ``--blocks bias,all`` restricts it, and with
``--seconds 0`` it only shows.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from rich.console import Console

from servotwin.analysis.maps.pool import shared, workplace
from servotwin.errors import InvalidInput


class Batch(NamedTuple):
    """A benchmark in pieces.

    Attributes
    ----------
    units : callable
        (blocks, count, seed) -> (key, task) of every piece, in the order in which they are to be done.
    measure : callable
        task -> numbers as JSON has them; picklable, and its result depends on the task alone.
    show : callable
        (numbers by key, console): prints the table of what is there.
    blocks : tuple of str
    """

    units: Callable[[Sequence[str], int, int], Iterable[tuple[str, Any]]]
    measure: Callable[[Any], Any]
    show: Callable[[Mapping[str, Any], Console], None]
    blocks: tuple[str, ...]


class _Piece(NamedTuple):
    key: str
    task: Any
    measure: Callable[[Any], Any]
    until: float


def read(path: Path) -> dict[str, Any]:
    """Read the numbers of a file by key; a last line that was cut off counts as absent.

    Raises
    ------
    InvalidInput
        The file is not one of a batch.
    """
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    found: dict[str, Any] = {}
    for number, line in enumerate(lines, 1):
        try:
            record = msgspec.json.decode(line)
            found[record["key"]] = record["numbers"]
        except (msgspec.DecodeError, KeyError, TypeError):
            if not line.endswith(b"\n"):
                break
            raise InvalidInput(f"{path} line {number}: is no record of a batch; give another file") from None
    return found


def run(
    batch: Batch, path: Path, blocks: Sequence[str], count: int, seed: int, jobs: int, seconds: float, console: Console
) -> dict[str, Any]:
    """Do what is missing in the file until the time is over, and return all that is there.

    Pieces that run at that time are finished, and no other is begun.
    """
    found = read(path)
    until = time.time() + seconds
    missing = [(key, task) for key, task in batch.units(blocks, count, seed) if key not in found]
    pieces = [_Piece(key, task, batch.measure, until) for key, task in missing]
    if not pieces or seconds <= 0.0:
        return found
    _end_last_line(path)
    with path.open("ab") as file, workplace(jobs):
        for done, (key, numbers) in enumerate(_measured(pieces), 1):
            found[key] = numbers
            file.write(msgspec.json.encode({"key": key, "numbers": numbers}) + b"\n")
            file.flush()
            passed = time.time() - until + seconds
            console.print(f"{done} of {len(pieces)} after {passed:.0f} s: {key}", highlight=False)
    return found


def _measured(pieces: Sequence[_Piece]) -> Iterator[tuple[str, Any]]:
    for piece, numbers in shared(_tried, pieces):
        if numbers is not None:
            yield piece.key, numbers


def _tried(piece: _Piece) -> Any:
    """Measure a piece; None: the time was over before it began."""
    return None if time.time() > piece.until else piece.measure(piece.task)


def _end_last_line(path: Path) -> None:
    """Cut off what a run that was killed left of its last line."""
    content = path.read_bytes() if path.exists() else b""
    if content and not content.endswith(b"\n"):
        path.write_bytes(content[: content.rfind(b"\n") + 1])


def _batches() -> dict[str, Batch]:
    from benchmarks import axis_certificates, axis_glances, axis_presets, logs, random_axes, random_settings
    from benchmarks.policies import loops

    single = {each.NAME: each.BATCH for each in (loops, logs, axis_certificates, axis_glances, random_settings)}
    return single | axis_presets.BATCHES | random_axes.BATCHES


def main(arguments: Sequence[str]) -> None:
    """Run a batch by its command line.

    Raises
    ------
    InvalidInput
        A block that does not exist, a file that is none of a batch.
    """
    batches = _batches()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.batch", description="Run a long benchmark in pieces.")
    parser.add_argument("name", choices=sorted(batches))
    parser.add_argument("file", type=Path, help="results, a line each; what is in it is not done again")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time after which nothing new is begun")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=200, help="machines of each block")
    parser.add_argument("--blocks", default="", help="with commas between them; all by default")
    given = parser.parse_args(arguments)
    batch, console = batches[given.name], Console(width=160)
    blocks = tuple(given.blocks.split(",")) if given.blocks else batch.blocks
    for block in blocks:
        if block not in batch.blocks:
            raise InvalidInput(f"--blocks {block!r}: does not exist; allowed are {', '.join(batch.blocks)}")
    found = run(batch, given.file, blocks, given.count, given.seed, given.jobs, given.seconds, console)
    batch.show(found, console)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InvalidInput as error:
        sys.exit(f"error: {error}")
