"""Outboxes on disk for tests."""

from pathlib import Path
from random import Random

from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import WindowMessage, checksum, pack_channel


def window(sequence: int, samples: int = 600) -> WindowMessage:
    random = Random(sequence)
    channels = (pack_channel("position", "m", [random.gauss(0.0, 1e-6) for _ in range(samples)]),)
    return WindowMessage("axis-1", "b0", sequence, 0.0, 10.0, channels, (), 0, "", "reference", checksum(channels))


def filled(folder: Path, windows: int) -> Path:
    """A closed outbox with windows, a letter and a number; its path."""
    path = folder / "outbox.sqlite"
    box = SqliteOutbox(path, "axis-1")
    for k in range(windows):
        box.put(window(k))
    box.put_letter(b"letter")
    box.set_number("cursor", 7)
    box.close()
    return path
