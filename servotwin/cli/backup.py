"""`servotwin backup` and `servotwin restore`: the twin's store copied while it is written to, and put back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.progress import Progress

from servotwin.store.backup import Progress as Report
from servotwin.store.backup import RowCounts, backup, restore
from servotwin.twin_service.twin_file import service_of


def back_up(config: Path, to: Path) -> None:
    """Copy the store of a twin's file to a new file; raises InvalidInput as `store.backup.backup` does."""
    with _shown("copying") as report:
        counts = backup(service_of(config).store, to, report)
    _say(to, counts)


def put_back(config: Path, backed_up: Path) -> None:
    """Make a backup the store of a twin's file; raises InvalidInput as `store.backup.restore` does."""
    store = service_of(config).store
    with _shown("putting back") as report:
        counts = restore(backed_up, store, report)
    _say(store, counts)


@contextmanager
def _shown(what: str) -> Iterator[Report]:
    with Progress(transient=True) as progress:
        task = progress.add_task(what, total=None)

        def report(left: int, whole: int) -> None:
            progress.update(task, total=whole, completed=whole - left)

        yield report


def _say(where: Path | str, counts: RowCounts) -> None:
    print(f"written: {where}: {counts.twins} servos, {counts.messages} messages, {counts.evidence} pieces of evidence")
