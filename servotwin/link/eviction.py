"""Which windows leave a full outbox: the oldest of those that tell little, then the oldest."""

from collections.abc import Mapping
from typing import NamedTuple

from servotwin.link.outbox import Key

UNINFORMATIVE = ("periodic",)
"""Reasons, by their first word, of windows that go first."""


class Kept(NamedTuple):
    """What is known of a window without reading it: its bytes, and whether it tells little."""

    size: int
    plain: bool


def is_plain(reason: str) -> bool:
    """Whether a window that was sent for this reason tells little."""
    return reason.partition(" ")[0].rstrip(",:;") in UNINFORMATIVE


def excess(index: Mapping[Key, Kept], windows: int, size: int) -> list[Key]:
    """What has to go so that at most so many windows and bytes are left; `index` is in order of age."""
    over, heavy = len(index) - windows, sum(kept.size for kept in index.values()) - size
    gone: list[Key] = []
    for key, kept in sorted(index.items(), key=lambda item: not item[1].plain):
        if over <= 0 and heavy <= 0:
            break
        gone.append(key)
        over, heavy = over - 1, heavy - kept.size
    return gone
