"""The work of a reproduction as independent tasks, done here or by a pool of processes."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Protocol, TypeVar

from servotwin.report import style
from servotwin.reproduction import figures
from servotwin.reproduction.beyond import Outcome
from servotwin.reproduction.claims import Claim, Result, measure
from servotwin.reproduction.figures import Plate
from servotwin.reproduction.runs import Runs

_R = TypeVar("_R", covariant=True)


class Task(Protocol[_R]):
    """A picklable piece of work."""

    def run(self) -> _R: ...


@lru_cache(maxsize=1)
def runs_of(preset: str) -> Runs:
    """This process's runs of a preset: tasks of one preset that follow one another share them."""
    return Runs(preset)


@dataclass(frozen=True)
class ClaimsTask:
    """Measure some claims in one preset."""

    preset: str
    claims: tuple[Claim, ...]

    def run(self) -> tuple[Result, ...]:
        """Their results."""
        return tuple(measure(claim, runs_of(self.preset)) for claim in self.claims)


@dataclass(frozen=True)
class Drawn:
    """A figure as drawn: its name, the vector image, and what came of the policies it compares, without their runs."""

    name: str
    vector: bytes
    outcomes: tuple[Outcome, ...] = ()


@dataclass(frozen=True)
class FigureTask:
    """Draw one figure for one preset and write its files."""

    preset: str
    name: str
    directory: Path

    def run(self) -> Drawn:
        """The vector image, which is also in NAME.svg, beside NAME.png."""
        runs, chosen = runs_of(self.preset), plate(self.name)
        path = style.save(chosen.draw(runs), self.directory, self.name)
        outcomes = tuple(replace(one, record=None) for one in chosen.measure(runs))
        return Drawn(self.name, path.read_bytes(), outcomes)


def plate(name: str) -> Plate[object]:
    """The figure of that name."""
    return next(one for one in figures.PLATES if one.name == name)


def perform(tasks: Sequence[Task[_R]], workers: int) -> Iterator[_R]:
    """Results as they come. With one worker everything happens in this process.

    An interrupt ends the workers; what they had not finished is lost, and no file is left half written.
    """
    if workers == 1 or len(tasks) < 2:
        yield from (task.run() for task in tasks)
        return
    with _interrupts_held():
        pool = multiprocessing.get_context("spawn").Pool(min(workers, len(tasks)), _ignore_interrupts)
    with pool:
        yield from pool.imap_unordered(_run, tasks)


def _run(task: Task[_R]) -> _R:
    return task.run()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let interrupts wait; what is started meanwhile never sees one, not even before `_ignore_interrupts` runs."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # its start would let interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _ignore_interrupts() -> None:
    """Leave an interrupt to the process that started the pool."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
