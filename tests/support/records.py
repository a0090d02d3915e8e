"""What a fleet of `deployment` has left on its disks, read from its databases."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from deployment import PATIENCE, Fleet

from servotwin.messages import Receipt, decode
from servotwin.messages.codec import decompress

Key = tuple[str, str, int]
"""(servo, boot, sequence)."""


def witnessed(fleet: Fleet) -> set[Key]:
    """Every window that was ever committed to an outbox."""
    rows = {
        servo: ask(fleet.folder / servo / "outbox.sqlite", "SELECT boot, sequence FROM witness")
        for servo in fleet.roles
    }
    return {(servo, *row) for servo, found in rows.items() for row in found}


def count_witnessed(fleet: Fleet) -> int:
    boxes = [fleet.folder / servo / "outbox.sqlite" for servo in fleet.roles]
    return sum(ask(box, "SELECT count(*) FROM witness")[0][0] for box in boxes)


# Acknowledged windows stay in an outbox for a while.
UNACKNOWLEDGED = "(boot, sequence) NOT IN (SELECT boot, sequence FROM acknowledged)"


def pending(fleet: Fleet) -> int:
    """Windows and letters that the edges have not delivered."""
    text = f"SELECT (SELECT count(*) FROM windows WHERE {UNACKNOWLEDGED}) + (SELECT count(*) FROM letters)"
    return sum(ask(fleet.folder / servo / "outbox.sqlite", text)[0][0] for servo in fleet.roles)


def dropped(fleet: Fleet) -> dict[str, int]:
    """Windows given up by all edges, by reason."""
    found: dict[str, int] = {}
    for servo in fleet.roles:
        for what, number in ask(fleet.folder / servo / "outbox.sqlite", "SELECT what, number FROM counts"):
            if what.startswith("dropped: "):
                found[what] = found.get(what, 0) + number
    return found


def stored(fleet: Fleet) -> list[Key]:
    """Every window in the twin's store, as often as it is there."""
    return ask(fleet.database, "SELECT servo, boot, sequence FROM messages WHERE kind = 'window'")


def count_stored(fleet: Fleet) -> int:
    """Windows in the twin's store; none before there is one."""
    try:
        return len(stored(fleet))
    except sqlite3.OperationalError:
        return 0


def receipts(fleet: Fleet) -> dict[str, list[Receipt]]:
    """Of each servo, in the order in which they came; none before there is a store."""
    found: dict[str, list[Receipt]] = {servo: [] for servo in fleet.roles}
    if not count_stored(fleet):
        return found
    letters = "SELECT servo, body, encoding FROM messages JOIN bodies ON message = id WHERE kind = 'letter' ORDER BY id"
    for servo, body, encoding in ask(fleet.database, letters):
        message = decode(decompress(body, encoding, 1 << 20))
        if isinstance(message, Receipt):
            found[servo].append(message)
    return found


def ask(path: Path, text: str) -> list[Any]:
    with closing(sqlite3.connect(path, timeout=PATIENCE)) as database:
        return database.execute(text).fetchall()
