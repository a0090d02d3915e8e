"""Messages between the bench and the process of its edges: plan and windows in, report out."""

from __future__ import annotations

import msgspec
from msgspec import Struct


class LoadPlan(Struct, frozen=True):
    """One run of the edges.

    Attributes
    ----------
    port : int
        Of the twin, on this machine.
    servos : int
    boot : str
    connections : int
        Kept open, with one request on its way on each.
    duration : float
        s.
    rate : float
        Windows/s that fall due, the servos taking turns; 0: each connection sends the next as soon as it may.
    news : float
        Share of windows with which the gap has moved to the next place.
    polls : bool
        Whether each servo asks for messages when its turn comes, and answers them.
    start : float
        Sample time of every servo's first window, s.
    outage : (float, float)
        s from the beginning: from when on and until when no request gets through; windows are kept meanwhile.
    seed : int
    """

    port: int
    servos: int
    boot: str
    connections: int
    duration: float
    rate: float = 0.0
    news: float = 0.0
    polls: bool = False
    start: float = 0.0
    outage: tuple[float, float] = (0.0, 0.0)
    seed: int = 0


class LoadReport(Struct, frozen=True):
    """Report of the edges.

    Attributes
    ----------
    seconds : float
        Until the last answer.
    windows, news, polls, updates, later : int
        Windows that were taken, those with news among them, polls, updates answered, and requests that had to be made
        once more because the twin said so.
    bytes : int
        Of the windows.
    cpu : float
        s of processor time, all threads.
    latency : tuple of float
        s from a window's request to its answer: median, 99 % and largest.
    latency_after : tuple of float
        The same of the windows after the outage.
    late : tuple of float
        s from when a window was due until its request, without those of the outage: median, 99 % and largest.
    waited : int
        Most windows that were kept at once.
    """

    seconds: float
    windows: int
    news: int
    polls: int
    updates: int
    later: int
    bytes: int
    cpu: float
    latency: tuple[float, float, float]
    latency_after: tuple[float, float, float]
    late: tuple[float, float, float]
    waited: int


class LoadPlace(Struct, frozen=True):
    """Windows of one gap.

    Attributes
    ----------
    gap : float
        rad.
    version : int
        Of the parameters that are in force at first at the servos of this place.
    windows : tuple of bytes
        Under the setting for this gap.
    moved : bytes
        Window of the gap of the next place, under the same setting.
    """

    gap: float
    version: int
    windows: tuple[bytes, ...]
    moved: bytes


class LoadStart(Struct, frozen=True):
    """First message to the process of the edges."""

    plan: LoadPlan
    places: tuple[LoadPlace, ...]


def encode_load(load: LoadStart) -> bytes:
    """As a file."""
    return msgspec.msgpack.encode(load)


def decode_load(data: bytes) -> LoadStart:
    """From a file."""
    return msgspec.msgpack.decode(data, type=LoadStart)


def shares(values: list[float]) -> tuple[float, float, float]:
    """Median, 99 % and largest of some values; 0 of none."""
    ordered = sorted(values) or [0.0]
    last = len(ordered) - 1
    return ordered[last // 2], ordered[round(0.99 * last)], ordered[-1]
