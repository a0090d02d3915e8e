"""Results of a demo: its runs, and one row for each step of the reference."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from servotwin.cli.demo_case import Case, Column
from servotwin.cosim import Loop
from servotwin.plant.display_units import DisplayUnit
from servotwin.reproduction.measures import MeasuredStep, Settling
from servotwin.reproduction.runs import Trace
from servotwin.reproduction.twin_runs import EstimateRecord, estimate_records


@dataclass(frozen=True, eq=False)
class DemoRun:
    """One run of a demo's machine."""

    column: Column
    loop: Loop
    trace: Trace

    @cached_property
    def estimates(self) -> tuple[EstimateRecord, ...]:
        """The twin's estimates beside the true gap."""
        return estimate_records(self.loop)

    @cached_property
    def steps(self) -> tuple[MeasuredStep, ...]:
        """Steps of the reference; where it begins at the position of rest, without that first stretch."""
        first = self.trace.steps[:1]
        rests = bool(first) and first[0].reference == self.trace.position[0]
        return self.trace.steps[1 if rests else 0 :]

    def estimate(self, step: MeasuredStep) -> EstimateRecord | None:
        """Last estimate of a step, one that was accepted where there is one; None: no window has its middle there."""
        here = [each for each in self.estimates if step.begin <= each.time < step.end]
        return next((each for each in reversed(here) if each.ok), here[-1] if here else None)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results without a twin, with the paper's rule where there is such a run, and with the twin."""

    case: Case
    alone: DemoRun
    published: DemoRun | None
    twinned: DemoRun

    @property
    def runs(self) -> tuple[DemoRun, ...]:
        """The runs in the order of the report."""
        return tuple(each for each in (self.alone, self.published, self.twinned) if each is not None)

    @property
    def settling(self) -> Settling:
        """Definition of settled, with the reference's amplitude."""
        return self.twinned.trace.settling

    @property
    def unit(self) -> DisplayUnit:
        """Unit of positions."""
        return self.case.unit(self.settling.scale)


@dataclass(frozen=True)
class DemoStep:
    """Results of one step: of each run in the order of the report, with the twin's estimate of the gap."""

    number: int
    steps: tuple[MeasuredStep, ...]
    estimate: EstimateRecord | None
    published_estimate: EstimateRecord | None

    @property
    def gap(self) -> float:
        """True gap at the estimate, or in the middle of the step, rad."""
        last = self.steps[-1]
        return 0.5 * (last.gap_begin + last.gap_end) if self.estimate is None else self.estimate.truth

    @property
    def left(self) -> float:
        """Largest error that remains with the twin, m or rad."""
        return left(self.steps[-1])


def left(step: MeasuredStep) -> float:
    """Largest error that remains at the end of a step, m or rad."""
    return abs(step.bias) + step.amplitude
