"""`servotwin backup` and `servotwin restore`: copy the twin's store while the twin runs, and restore it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servotwin.cli.output import progress_bar
from servotwin.errors import InvalidInput
from servotwin.store.backup import Progress as Report
from servotwin.store.backup import RowCounts, backup, clauses, newest_of, restore
from servotwin.twin_service.store_mark import lost_since
from servotwin.twin_service.twin_file import service_of


def backup_store(config: Path, to: Path, replace: bool) -> None:
    """Copy the store of a twin's file to another file.

    Raises
    ------
    InvalidInput
        As `store.backup.backup`; or the store has lost messages, or servos are set aside: the copy of it is made, but
        replaces no earlier one.
    """
    store = service_of(config).store
    lost = lost_since(store, newest_of(store, to))
    if lost and replace and to.exists():
        raise InvalidInput(
            f"backup {to}: is not replaced, because the store has lost messages ({lost}); give another file"
        )
    with _progress("copying") as report:
        copied = backup(store, to, report, replace)
    _print_counts(to, copied.rows)
    if copied.left_out:
        raise InvalidInput(
            f"backup {to}: is written, but holds nothing of servos that are set aside ({clauses(copied.left_out)}); "
            "keep the earlier ones, put the rows right, and back up again"
        )
    if lost:
        raise InvalidInput(f"backup {to}: is written, but its store has lost messages ({lost}); keep the earlier ones")


def restore_store(config: Path, backed_up: Path) -> None:
    """Restore a backup to the store of a twin's file; raises InvalidInput as `store.backup.restore` does."""
    store = service_of(config).store
    with _progress("restoring") as report:
        copied = restore(backed_up, store, report)
    _print_counts(store, copied.rows)
    if copied.left_out:
        print(
            f"missing: the backup holds nothing of {clauses(copied.left_out)}: these servos begin anew, and their "
            "edges are asked for the windows that they keep; an earlier backup may hold them"
        )


@contextmanager
def _progress(description: str) -> Iterator[Report]:
    with progress_bar() as progress:
        task = progress.add_task(description, total=None)

        def report(left: int, total: int) -> None:
            progress.update(task, total=total, completed=total - left)

        yield report


def _print_counts(where: Path | str, counts: RowCounts) -> None:
    print(f"written: {where}: {counts.twins} servos, {counts.messages} messages, {counts.evidence} pieces of evidence")
