"""Benchmarks of quality, which run alone: estimator, windows, edge, policies, loops, novelty, triage, ticks, fleet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import (
    accuracy,
    certificates,
    compensation,
    endurance,
    friction_feedforward,
    glances,
    hostile_command,
    overload,
    tick,
)
from benchmarks import windows as from_windows
from benchmarks.fleet import command as whole
from benchmarks.fleet.setting import QUICK, FleetScale
from benchmarks.novelty import command as worth_sending
from benchmarks.policies import command as side_by_side
from benchmarks.policies import loops as in_the_loop
from servotwin.errors import InvalidInput

QUICK_SIZE = 0.02


class QualityBenchmark(NamedTuple):
    """A benchmark that runs alone.

    Attributes
    ----------
    run : callable
        (date, output file or None, scale)
    quick, whole : object
        Scale of a check, and of the documented figures.
    """

    run: Callable[..., object]
    quick: Any
    whole: Any


ALONE: Mapping[str, QualityBenchmark] = {
    accuracy.NAME: QualityBenchmark(accuracy.accuracy, QUICK_SIZE, 1.0),
    hostile_command.NAME: QualityBenchmark(
        hostile_command.hostile_twins, hostile_command.QUICK, hostile_command.MACHINES
    ),
    whole.NAME: QualityBenchmark(whole.fleet, QUICK, FleetScale()),
    overload.NAME: QualityBenchmark(overload.overload, overload.QUICK, overload.SMALL),
    endurance.NAME: QualityBenchmark(endurance.endure, endurance.QUICK, endurance.MINUTES),
    glances.NAME: QualityBenchmark(glances.triage, glances.QUICK, glances.GAPS),
    side_by_side.NAME: QualityBenchmark(side_by_side.policies, side_by_side.QUICK, side_by_side.MACHINES),
    in_the_loop.NAME: QualityBenchmark(in_the_loop.loops, in_the_loop.QUICK, in_the_loop.MACHINES),
    compensation.NAME: QualityBenchmark(compensation.compensation, compensation.QUICK, compensation.MACHINES),
    friction_feedforward.NAME: QualityBenchmark(
        friction_feedforward.compare, friction_feedforward.QUICK, friction_feedforward.MACHINES
    ),
    certificates.NAME: QualityBenchmark(certificates.certificates, certificates.QUICK, certificates.MACHINES),
    tick.NAME: QualityBenchmark(tick.ticks, tick.QUICK, tick.SECONDS),
    from_windows.NAME: QualityBenchmark(from_windows.windows, from_windows.QUICK, from_windows.WINDOWS),
    worth_sending.NAME: QualityBenchmark(worth_sending.novelty, worth_sending.QUICK, None),
}

FULL: Mapping[str, Any] = {whole.NAME: FleetScale().full(), overload.NAME: overload.OverloadScale()}
"""Scale of the full length, for benchmarks that have one."""
SEEDED = (from_windows.NAME, in_the_loop.NAME, certificates.NAME, endurance.NAME)
"""Benchmarks whose machines follow a seed that can be chosen."""


def run_alone(
    names: Sequence[str],
    date: str,
    output: Path | None,
    quick: bool,
    others: bool,
    full: bool = False,
    seed: int | None = None,
    minutes: float | None = None,
    servos: int | None = None,
) -> bool:
    """Run the named benchmark if it is one of quality; `others`: options that only speed benchmarks take were given.

    `full` applies to those of `FULL`: the full length of the documented figures. `seed` applies to those of `SEEDED`,
    `minutes` to the endurance, `servos` to that and the fleet.

    Raises
    ------
    InvalidInput
        Other names or options beside it.
    """
    name = next((name for name in names if name in ALONE), None)
    if full and (len(names) != 1 or names[0] not in FULL or quick):
        raise InvalidInput(f"--full: only bench {' or '.join(FULL)} takes it, and not with --quick")
    if seed is not None and not (len(names) == 1 and names[0] in SEEDED):
        raise InvalidInput(f"--seed: only bench {', '.join(SEEDED[:-1])} or {SEEDED[-1]} takes it")
    if minutes is not None and list(names) != [endurance.NAME]:
        raise InvalidInput(f"--minutes: only bench {endurance.NAME} takes it")
    if servos is not None and list(names) not in ([endurance.NAME], [whole.NAME]):
        raise InvalidInput(f"--servos: only bench {endurance.NAME} or {whole.NAME} takes it")
    if name is None:
        return False
    if len(names) > 1 or others:
        raise InvalidInput(f"bench {name} stands alone: of the options it takes --json and --quick only")
    chosen = ALONE[name]
    scale = FULL[name] if full else chosen.quick if quick else chosen.whole
    scale = scale if minutes is None else minutes
    if isinstance(scale, FleetScale) and servos is not None:
        scale, servos = scale.of(servos), None
    chosen_by_user = {"seed": seed, "servos": servos}
    chosen.run(date, output, scale, **{name: value for name, value in chosen_by_user.items() if value is not None})
    return True
