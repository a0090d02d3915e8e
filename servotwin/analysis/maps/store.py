"""Store of the finished pieces of a map, and computation of the missing ones: an interrupted map can be continued."""

from __future__ import annotations

import json
import zipfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from servotwin.analysis.maps.measures import MEASURES, Measures, joined, measured
from servotwin.analysis.maps.pool import shared, workplace
from servotwin.analysis.maps.settings import MapSettings
from servotwin.errors import InvalidInput
from servotwin.runtime import files


@dataclass(frozen=True)
class MapStore:
    """The folder of one map: settings.json and chunks/NNNNNN.npz, each with the fingerprint of its settings.

    Parameters
    ----------
    directory : Path
        Made if missing.
    settings : MapSettings

    Raises
    ------
    InvalidInput
        The folder cannot be written, or holds a map with other settings.
    """

    directory: Path
    settings: MapSettings

    def __post_init__(self) -> None:
        files.make_directory(self.directory)
        files.make_directory(self._folder)
        path = self.directory / "settings.json"
        # JSON turns tuples into lists: compare what a file gives back.
        described = json.loads(json.dumps(self.settings.described()))
        if path.exists():
            _compare(path, described)
        else:
            files.write_text(path, json.dumps(described, indent=2) + "\n")

    @property
    def _folder(self) -> Path:
        return self.directory / "chunks"

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"

    def save(self, number: int, measures: Measures) -> None:
        """Write one piece, whole or not at all."""
        values = {name: getattr(measures, name) for name in MEASURES}
        with files.atomic_output(self._path(number)) as temporary:
            np.savez(temporary, allow_pickle=False, fingerprint=np.array(self.settings.fingerprint), **values)

    def load(self, number: int) -> Measures | None:
        """Read a piece; None when it is missing or incomplete.

        Raises
        ------
        InvalidInput
            It belongs to a map with other settings.
        """
        path = self._path(number)
        try:
            with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
                fingerprint = str(file["fingerprint"])
                measures = Measures(*(file[name] for name in MEASURES))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        if fingerprint != self.settings.fingerprint:
            raise InvalidInput(f"{path}: belongs to a map with other settings; choose another --out")
        return measures if len(measures.settled) == len(self.settings.chunks[number]) else None

    def missing(self) -> tuple[int, ...]:
        """Numbers of the pieces that are still to be computed."""
        return tuple(number for number in range(len(self.settings.chunks)) if self.load(number) is None)


def _compare(path: Path, described: dict[str, Any]) -> None:
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InvalidInput(f"{path}: cannot be read as the settings of a map; choose another --out") from None
    for key, value in described.items():
        there = stored.get(key) if isinstance(stored, dict) else None
        if there != value:
            raise InvalidInput(
                f"{path}: this folder holds a map with {_shown(key, there, value)};"
                " give the same settings to go on with it, or choose another --out"
            )


def _shown(key: str, there: object, value: object) -> str:
    """Name the difference; in full where it is short."""
    words = [json.dumps(each) for each in (there, value)]
    return f"{key} = {words[0]}, not {words[1]}" if max(map(len, words)) <= 40 else f"another {key}"


@dataclass(frozen=True)
class Piece:
    """The work of one chunk, as it is sent to a worker."""

    settings: MapSettings
    number: int
    cells: range

    def measured(self) -> Measures:
        """Run its cells."""
        return measured(self.settings, self.cells)


def compute(store: MapStore, workers: int | None, scheduler: str | None, console: Console) -> None:
    """Compute and store the missing pieces, under a progress bar."""
    chunks = store.settings.chunks
    pieces = [Piece(store.settings, number, chunks[number]) for number in store.missing()]
    total = len(chunks)
    if not pieces:
        return
    try:
        with (
            workplace(workers, scheduler),
            Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                console=console,
            ) as progress,
            closing(shared(Piece.measured, pieces)) as outcomes,
        ):
            bar = progress.add_task("mapping", total=total, completed=total - len(pieces))
            for piece, measures in outcomes:
                store.save(piece.number, measures)
                progress.advance(bar)
    except KeyboardInterrupt:
        done = total - len(store.missing())
        raise KeyboardInterrupt(
            f"interrupted: {done} of {total} pieces are in {store.directory}; the same command goes on from there"
        ) from None


def collected(store: MapStore) -> Measures:
    """Join all pieces into one."""
    parts = [store.load(number) for number in range(len(store.settings.chunks))]
    whole = [part for part in parts if part is not None]
    if len(whole) < len(parts):
        raise InvalidInput(f"{store.directory}: pieces of the map have disappeared; give the same command again")
    return joined(whole)
