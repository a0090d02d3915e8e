"""Benchmarks of quality, which run alone: estimator, windows, edge, policies, novelty, triage, ticks, fleet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks import accuracy, compensation, endurance, glances, tick
from benchmarks import windows as from_windows
from benchmarks.fleet import command as whole
from benchmarks.fleet.setting import QUICK, FleetScale
from benchmarks.novelty import command as worth_sending
from benchmarks.policies import command as side_by_side
from benchmarks.policies import loops as in_the_loop
from servotwin.errors import InvalidInput

QUICK_SIZE = 0.02


def _estimator(date: str, output: Path | None, quick: bool) -> None:
    accuracy.accuracy(date, output, QUICK_SIZE if quick else 1.0)


def _hostile(date: str, output: Path | None, quick: bool) -> None:
    endurance.endurance(date, output, endurance.QUICK if quick else endurance.MACHINES)


def _policies(date: str, output: Path | None, quick: bool) -> None:
    side_by_side.policies(date, output, side_by_side.QUICK if quick else side_by_side.MACHINES)


def _loops(date: str, output: Path | None, quick: bool) -> None:
    in_the_loop.loops(date, output, in_the_loop.QUICK if quick else in_the_loop.MACHINES)


def _compensation(date: str, output: Path | None, quick: bool) -> None:
    compensation.compensation(date, output, compensation.QUICK if quick else compensation.MACHINES)


def _novelty(date: str, output: Path | None, quick: bool) -> None:
    worth_sending.novelty(date, output, worth_sending.QUICK if quick else None)


def _fleet(date: str, output: Path | None, quick: bool) -> None:
    whole.fleet(date, output, QUICK if quick else FleetScale())


def _triage(date: str, output: Path | None, quick: bool) -> None:
    glances.triage(date, output, glances.QUICK if quick else glances.GAPS)


def _windows(date: str, output: Path | None, quick: bool) -> None:
    from_windows.windows(date, output, from_windows.QUICK if quick else from_windows.WINDOWS)


def _tick(date: str, output: Path | None, quick: bool) -> None:
    tick.ticks(date, output, tick.QUICK if quick else tick.SECONDS)


ALONE: Mapping[str, Callable[[str, Path | None, bool], None]] = {
    accuracy.NAME: _estimator,
    endurance.NAME: _hostile,
    whole.NAME: _fleet,
    glances.NAME: _triage,
    side_by_side.NAME: _policies,
    in_the_loop.NAME: _loops,
    compensation.NAME: _compensation,
    tick.NAME: _tick,
    from_windows.NAME: _windows,
    worth_sending.NAME: _novelty,
}


def run_alone(
    names: Sequence[str],
    date: str,
    output: Path | None,
    quick: bool,
    others: bool,
    full: bool = False,
    seed: int | None = None,
) -> bool:
    """Run the named benchmark if it is one of quality; `others`: options that only speed benchmarks take were given.

    `full` applies to the fleet only: the full length of the documented figures. `seed` applies to the windows only.

    Raises
    ------
    InvalidInput
        Other names or options beside it.
    """
    name = next((name for name in names if name in ALONE), None)
    if full and (tuple(names) != (whole.NAME,) or quick):
        raise InvalidInput(f"--full: only bench {whole.NAME} takes it, and not with --quick")
    if seed is not None and tuple(names) != (from_windows.NAME,):
        raise InvalidInput(f"--seed: only bench {from_windows.NAME} takes it")
    if name is None:
        return False
    if len(names) > 1 or others:
        raise InvalidInput(f"bench {name} stands alone: of the options it takes --json and --quick only")
    if full:
        whole.fleet(date, output, FleetScale().full())
    elif seed is not None:
        from_windows.windows(date, output, from_windows.QUICK if quick else from_windows.WINDOWS, seed)
    else:
        ALONE[name](date, output, quick)
    return True
