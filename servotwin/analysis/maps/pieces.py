"""The pieces of a map: what is missing is computed, here or elsewhere, and kept."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from servotwin.analysis.maps.measures import Measures, joined, measured
from servotwin.analysis.maps.pool import shared, workplace
from servotwin.analysis.maps.settings import MapSettings
from servotwin.analysis.maps.store import Store
from servotwin.errors import InvalidInput


@dataclass(frozen=True)
class Piece:
    """The work of one chunk, as it is sent to a worker."""

    settings: MapSettings
    number: int
    cells: range

    def measured(self) -> Measures:
        """What its cells do."""
        return measured(self.settings, self.cells)


def compute(store: Store, workers: int | None, scheduler: str | None, console: Console) -> None:
    """Compute and keep the pieces that are missing, under a progress bar."""
    chunks = store.settings.chunks
    pieces = [Piece(store.settings, number, chunks[number]) for number in store.missing()]
    total = len(chunks)
    if not pieces:
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with (
            workplace(workers, scheduler),
            Progress(*columns, TimeRemainingColumn(), console=console) as progress,
            closing(shared(Piece.measured, pieces)) as outcomes,
        ):
            bar = progress.add_task("mapping", total=total, completed=total - len(pieces))
            for piece, measures in outcomes:
                store.keep(piece.number, measures)
                progress.advance(bar)
    except KeyboardInterrupt:
        done = total - len(store.missing())
        raise KeyboardInterrupt(
            f"interrupted: {done} of {total} pieces are in {store.directory}; the same command goes on from there"
        ) from None


def collected(store: Store) -> Measures:
    """All pieces as one."""
    parts = [store.kept(number) for number in range(len(store.settings.chunks))]
    whole = [part for part in parts if part is not None]
    if len(whole) < len(parts):
        raise InvalidInput(f"{store.directory}: pieces of the map vanished meanwhile; give the same command again")
    return joined(whole)
