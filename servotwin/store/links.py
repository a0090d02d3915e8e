"""The evidence chain as it is told: window, what was found of it, the version that stands on it, its effect."""

from __future__ import annotations

from typing import NamedTuple


class Held(NamedTuple):
    """A window as the store knows it.

    Attributes
    ----------
    start : float
        Sample time of its first sample, s.
    received, done : float, float or None
        s since the epoch, when it came and when it was processed.
    """

    id: int
    servo: str
    boot: str
    sequence: int
    start: float
    received: float
    done: float | None


class Found(NamedTuple):
    """Evidence as it is kept; `made`: s since the epoch, the others as of `Evidence`."""

    id: int
    kind: str
    message: int
    body: bytes
    version: int | None
    gap: float | None
    std: float | None
    status: str
    context: str
    tail: float | None
    made: float


class Effect(NamedTuple):
    """What a version did, as the first window under it shows.

    Attributes
    ----------
    window : Held
        The first one that was cut under the version.
    before, after : Found
        The glance or estimate of the window that the version stands on, and of the first one under it: their `tail`,
        `gap` and `status` are what changed.
    """

    window: Held
    before: Found | None
    after: Found


class Step(NamedTuple):
    """An update and what became of it: receipts and fallbacks that name its version, and the effect, if one shows."""

    update: Found
    answers: tuple[Found, ...]
    effect: Effect | None


class Link(NamedTuple):
    """A window and everything that follows from it: the evidence chain.

    Attributes
    ----------
    window : Held
    found : tuple of Found
        Glances, estimates, redesigns and so on, updates excepted.
    steps : tuple of Step
        Its updates: none, mostly, or one.
    """

    window: Held
    found: tuple[Found, ...]
    steps: tuple[Step, ...]
