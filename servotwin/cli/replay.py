"""`servotwin replay`: repeat a servo's stored estimates from the store alone, and compare them bit for bit."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from servotwin.cli.audit import known_servo
from servotwin.cli.check import store_to_read
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, NAME_PATTERN, InvalidMessage
from servotwin.messages.codec import decompress
from servotwin.store.records import StoredEvidence, WindowTrace
from servotwin.store.store import Store
from servotwin.twin.model_registry import ServoModel
from servotwin.twin.replay import ReplayResult, replay
from servotwin.twin_service.twin_file import read_twin

DEG = 180.0 / math.pi
_PAGE = 100
SAME, OTHER = "the same, bit for bit", "NOT the same"
_UNREADABLE = "NOT repeated: the stored data cannot be decoded"
_EMPTIED = "not repeated: retention deleted the window's body"
_GLANCED = "not estimated: screening was enough"
FAILED = "not estimated: the window could not be processed"
WAITING = "not yet processed"
BAD = (OTHER, _UNREADABLE)


class _ReplayedWindow(NamedTuple):
    """Result of estimating one window again.

    Attributes
    ----------
    window : str
        "boot/sequence".
    result : str
        SAME, OTHER, or the reason why nothing was compared.
    detail : str
        Sentence on a result that is one of BAD; empty otherwise.
    differs : tuple of str
        Differences from the time of the estimate: versions, sources, processor, model, settings; each with both values.
    """

    window: str
    result: str
    detail: str = ""
    differs: tuple[str, ...] = ()


def print_replay(servo: str, config: Path, window: str | None, present: bool) -> bool:
    """Repeat the estimates of a servo's windows and print the comparison; returns True where none differs.

    Parameters
    ----------
    servo : str
    config : Path
        The twin's file.
    window : str, optional
        "boot/sequence": only this one.
    present : bool
        Use the model and settings of the twin's present file, not the stored ones.

    Raises
    ------
    InvalidInput
        There is no store, or no such window in it, or it is damaged.
    """
    only, model = _identity(window), read_twin(config).fleet.model_of(servo) if present else None
    counts, differing = Counter[str](), Counter[str]()
    with store_to_read(config) as store:
        for replayed in _replay_windows(store, servo, model, only):
            counts[replayed.result] += 1
            differing.update(replayed.differs)
            if replayed.detail:
                print(f"window {replayed.window}: {replayed.detail}")
        if not counts:
            known_servo(store, servo)
            asked = "" if window is None else f" {window}"
            raise InvalidInput(f"servo {servo!r}: no window{asked} of it was ever stored")
        print(_summary(servo, counts, differing))
    return not any(counts[bad] for bad in BAD)


def _replay_windows(
    store: Store, servo: str, model: ServoModel | None, only: tuple[str, int] | None
) -> Iterator[_ReplayedWindow]:
    """Replay the windows of a servo, newest first."""
    before = None
    while traces := store.audit(servo, limit=_PAGE, window=only, before=before):
        contexts = store.contexts({record.context for trace in traces for record in trace.evidence if record.context})
        for trace in traces:
            yield _replay_window(store, trace, contexts, model)
        before = traces[-1].window.id


def _summary(servo: str, counts: Counter[str], differing: Counter[str]) -> str:
    """Text with the counts by result, and the differences from the time of the estimates."""
    lines = [f"servo {servo}: {_windows(sum(counts.values()))}"]
    lines += [f"  {number:6d} {result}" for result, number in counts.most_common()]
    lines += [f"  changed since {_windows(number)}: {part}" for part, number in sorted(differing.items())]
    return "\n".join(lines)


def _replay_window(
    store: Store, trace: WindowTrace, contexts: dict[str, str], model: ServoModel | None
) -> _ReplayedWindow:
    window = trace.window
    name = f"{window.boot}/{window.sequence}"
    estimate = next((one for one in reversed(trace.evidence) if one.kind == "estimate"), None)
    if estimate is None:
        return _ReplayedWindow(name, WAITING if window.done is None else _GLANCED)
    if estimate.status.startswith("failed"):
        return _ReplayedWindow(name, FAILED)
    message = store.window(window.servo, window.boot, window.sequence)
    if message is None or not message.body:
        return _ReplayedWindow(name, _EMPTIED)
    try:
        data = decompress(message.body, message.encoding, MAX_BYTES)
        return _compare(name, estimate, replay(data, estimate.body, contexts.get(estimate.context, ""), model))
    except (InvalidInput, InvalidMessage) as error:
        return _ReplayedWindow(name, _UNREADABLE, str(error))


def _compare(name: str, stored: StoredEvidence, again: ReplayResult) -> _ReplayedWindow:
    if again.same:
        return _ReplayedWindow(name, SAME, "", again.differs)
    gaps = f"gap {_degrees(stored.gap)} deg then, {_degrees(again.estimate.gap)} deg now"
    why = "" if again.differs else "; no recorded version, model or setting explains it"
    return _ReplayedWindow(name, OTHER, f"{gaps}; changed: {', '.join(again.changed)}{why}", again.differs)


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
