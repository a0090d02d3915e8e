"""Workloads, their contestants, and checks of the answers."""

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
        Reason for which it cannot take part; empty when it can.
    remark : callable
        Remark, requested after the timing.
    """

    name: str
    prepare: Callable[[], Job]
    missing: str = ""
    remark: Callable[[], str] = _nothing


@dataclass(frozen=True)
class Check:
    """Error of an answer: `of(answer)` in `unit`, against the reference in `name`."""

    name: str
    unit: str
    of: Callable[[Array], float]


@dataclass(frozen=True)
class Workload:
    """A job for several contestants, servotwin first, and the checks of their answers.

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
