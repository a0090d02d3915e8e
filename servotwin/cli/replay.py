"""`servotwin replay`: a servo's stored estimates made again from what the store holds, and compared bit for bit."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, NAME_PATTERN, InvalidMessage
from servotwin.messages.compression import decompress
from servotwin.store.records import StoredEvidence, WindowTrace
from servotwin.store.store import Store
from servotwin.twin.model_registry import ServoModel
from servotwin.twin.replay import ReplayResult, replay
from servotwin.twin_service.command import open_existing_store
from servotwin.twin_service.twin_file import read_twin, service_of

DEG = 180.0 / math.pi
PAGE = 100
SAME, OTHER = "the same, bit for bit", "NOT the same"
UNREADABLE = "NOT made again, as what is stored is not understood"
EMPTIED = "not made again, as retention took the window"
GLANCED = "not estimated, as a glance was enough"
FAILED = "not estimated, as nothing could be made of the window"
WAITING = "not yet worked on"
BAD = (OTHER, UNREADABLE)


class Again(NamedTuple):
    """Result of estimating one window again.

    Attributes
    ----------
    window : str
        "boot/sequence".
    result : str
        SAME, OTHER, or why there was nothing to compare.
    said : str
        In words, where it is one of BAD.
    differs : tuple of str
        What is not as it was then: versions, sources, processor, model, settings; each with both values.
    """

    window: str
    result: str
    said: str = ""
    differs: tuple[str, ...] = ()


def tell(servo: str, config: Path, window: str | None, present: bool) -> bool:
    """Make the estimates of a servo's windows again and print what came of it; whether all are the same.

    Parameters
    ----------
    servo : str
    config : Path
        The twin's file.
    window : str, optional
        "boot/sequence": only this one.
    present : bool
        With model and settings as the twin's file has them now, not as they were then.

    Raises
    ------
    InvalidInput
        There is no store, or no such window in it.
    """
    only, model = _identity(window), read_twin(config).fleet.model_of(servo) if present else None
    counts, differing = Counter[str](), Counter[str]()
    store = open_existing_store(service_of(config))
    try:
        for again in replayed(store, servo, model, only):
            counts[again.result] += 1
            differing.update(again.differs)
            if again.said:
                print(f"window {again.window}: {again.said}")
    finally:
        store.close()
    if not counts:
        raise InvalidInput(f"servo {servo!r}: no window{'' if window is None else f' {window}'} of it was ever stored")
    print(summary(servo, counts, differing))
    return not any(counts[bad] for bad in BAD)


def replayed(store: Store, servo: str, model: ServoModel | None, only: tuple[str, int] | None) -> Iterator[Again]:
    """Each window of a servo, newest first."""
    before = None
    while links := store.audit(servo, limit=PAGE, window=only, before=before):
        contexts = store.contexts({found.context for link in links for found in link.found if found.context})
        for link in links:
            yield _again(store, link, contexts, model)
        before = links[-1].window.id


def summary(servo: str, counts: Counter[str], differing: Counter[str]) -> str:
    """Counts by result, and what differs since."""
    lines = [f"servo {servo}: {_windows(sum(counts.values()))}"]
    lines += [f"  {number:6d} {result}" for result, number in counts.most_common()]
    lines += [f"  otherwise since {_windows(number)}: {part}" for part, number in sorted(differing.items())]
    return "\n".join(lines)


def _again(store: Store, link: WindowTrace, contexts: dict[str, str], model: ServoModel | None) -> Again:
    held = link.window
    name = f"{held.boot}/{held.sequence}"
    found = next((one for one in reversed(link.found) if one.kind == "estimate"), None)
    if found is None:
        return Again(name, WAITING if held.done is None else GLANCED)
    if found.status.startswith("failed"):
        return Again(name, FAILED)
    kept = store.window(held.servo, held.boot, held.sequence)
    if kept is None or not kept.body:
        return Again(name, EMPTIED)
    try:
        window = decompress(kept.body, kept.encoding, MAX_BYTES)
        return _compared(name, found, replay(window, found.body, contexts.get(found.context, ""), model))
    except (InvalidInput, InvalidMessage) as error:
        return Again(name, UNREADABLE, str(error))


def _compared(name: str, found: StoredEvidence, again: ReplayResult) -> Again:
    if again.same:
        return Again(name, SAME, "", again.differs)
    gaps = f"gap {_degrees(found.gap)} deg then, {_degrees(again.estimate.gap)} deg now"
    why = "" if again.differs else "; no version, model or setting that was noted explains it"
    return Again(name, OTHER, f"{gaps}; changed: {', '.join(again.changed)}{why}", again.differs)


def _degrees(gap: float | None) -> str:
    return "unknown" if gap is None or not math.isfinite(gap) else f"{gap * DEG:.6g}"


def _windows(number: int) -> str:
    return f"{number} window{'' if number == 1 else 's'}"


def _identity(window: str | None) -> tuple[str, int] | None:
    """(boot, sequence) of "boot/sequence"."""
    if window is None:
        return None
    boot, _, sequence = window.rpartition("/")
    if not (re.match(NAME_PATTERN, boot) and sequence.isascii() and sequence.isdecimal() and len(sequence) <= 16):
        raise InvalidInput(f"window {window!r}: give BOOT/NUMBER, as `servotwin audit` shows it")
    return boot, int(sequence)
