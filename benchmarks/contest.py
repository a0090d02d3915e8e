"""What is measured: a workload, who takes part in it, and how far off an answer is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from servotwin.hybrid.automaton import Array

Job: TypeAlias = Callable[[], Array]


def _nothing() -> str:
    return ""


@dataclass(frozen=True)
class Contestant:
    """One way to do a workload.

    Attributes
    ----------
    name : str
    prepare : callable
        Builds and compiles what is needed once, and returns the job that is timed.
    missing : str
        Why it cannot take part; empty when it can.
    remark : callable
        What to say about it, asked for after the timing.
    """

    name: str
    prepare: Callable[[], Job]
    missing: str = ""
    remark: Callable[[], str] = _nothing


@dataclass(frozen=True)
class Check:
    """How far off an answer is: `of(answer)` in `unit`, against what `name` says."""

    name: str
    unit: str
    of: Callable[[Array], float]


@dataclass(frozen=True)
class Workload:
    """A job that several contestants do, servotwin first, and how their answers are judged.

    Attributes
    ----------
    pace : callable
        The median time (s) as the figure that is usual for this workload, for example "2100 x real time".
    """

    name: str
    title: str
    contestants: tuple[Contestant, ...]
    checks: tuple[Check, ...]
    pace: Callable[[float], str]
