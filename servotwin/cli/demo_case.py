"""Machine of a demo: one that wears, in runs that differ by its twin only, and the words for them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import servotwin as st
from servotwin.cli.loop_report import CHANGES
from servotwin.cli.simulate import read_scenario
from servotwin.errors import InvalidInput
from servotwin.plant.display_units import DisplayUnit, command_unit, gap_in_words, position_unit
from servotwin.plant.servo import PRESETS
from servotwin.plant.signals import as_pieces, reference_changes
from servotwin.redesign.registry import paper_k_dz
from servotwin.reproduction.runs import Trace
from servotwin.reproduction.twin_runs import TwinJob
from servotwin.simulation import Run
from servotwin.twin.model import TwinModel

PAPER = "paper"
BIAS = 0.05  # V on the motor's input, such as an amplifier's offset
_LEAST = 0.1  # of a unit: a reference of a smaller amplitude is shown in the thousandth of the unit
_FEWEST = 2  # steps of the reference
_ALONE = "the machine's own controller"
_POLICIES = {
    "certified": "the certified twin: the loop begins on a setting that is verified for every gap of the stated range, "
    "and gets settings verified for the twin's estimates",
    "margin": "after each step a dead zone for the gap that the twin estimates, and for the noise",
    "hysteresis": "after each step a dead zone with hysteresis for the gap that the twin estimates",
    PAPER: "after each step a dead zone as wide as the gap that the twin estimates",
}
"""What a twin of each policy does."""


@dataclass(frozen=True, eq=False)
class Column:
    """One run: the heading of its column, what the machine runs with, in words and explained, and its scenario."""

    head: str
    name: str
    explained: str
    scenario: st.Scenario


@dataclass(frozen=True, eq=False)
class Case:
    """A machine that wears, and its runs.

    Attributes
    ----------
    title, story : str
        Of the page; what the machine does, below the picture.
    alone, twinned : Column
        Under its own controller; with its twin.
    published : Column or None
        With the paper's dead zone, Eq 21.
    left_out : str
        Sentence that says why there is no such run; empty where there is one.
    paper : bool
        The machine is the paper's: drawn and measured as in its figures.
    """

    title: str
    story: str
    alone: Column
    twinned: Column
    published: Column | None = None
    left_out: str = ""
    paper: bool = False

    @property
    def columns(self) -> tuple[Column, ...]:
        """The runs in the order of the report."""
        return tuple(each for each in (self.alone, self.published, self.twinned) if each is not None)

    @property
    def scenario(self) -> st.Scenario:
        """The machine with its twin."""
        return self.twinned.scenario

    def trace(self, run: Run) -> Trace:
        """Reduce a run to what is drawn and measured."""
        return Trace.of(run) if self.paper else Trace.whole(run)

    def unit(self, amplitude: float) -> DisplayUnit:
        """Unit in which positions are shown, for the reference's amplitude (m or rad)."""
        unit = position_unit(self.scenario.servo)
        return unit if unit.factor * amplitude >= _LEAST else unit.small


def paper_case(preset: str) -> Case:
    """The paper's servo alone, with the twin as published, and with the certified one.

    Raises
    ------
    InvalidInput
        There is no such servo.
    """
    if preset not in PRESETS:
        raise InvalidInput(
            f"--preset {preset!r}: is none of the paper's servos: give one of {', '.join(PRESETS)}; another machine is "
            "shown by servotwin demo SCENARIO.toml"
        )
    published = TwinJob(preset).scenario_to_run().replace(input_bias=BIAS)
    certified = st.Scenario.preset("certified").with_servo(published.servo).replace(input_bias=BIAS)
    return Case(
        "A worn servo, alone and with its twin",
        f"Preset {preset}: a square wave of ±1 mm while the gap wears from 0 to 20 deg in 200 s, with a bias of "
        f"{1e3 * BIAS:g} mV on the motor's input.",
        Column("alone", "without a twin", _ALONE, published.replace(twin=published.twin.replace(enabled=False))),
        Column("certified", "certified twin", _POLICIES["certified"], certified),
        Column("published", "twin as published", f"the paper's twin: {_POLICIES[PAPER]}", published),
        paper=True,
    )


def scenario_case(path: Path) -> Case:
    """The machine of a scenario alone, with the paper's dead zone where it can be had, and with the scenario's twin.

    Raises
    ------
    InvalidInput
        The scenario cannot be read, has no twin, no steps or no wear.
    """
    scenario = read_scenario(path)[1]
    _check_story(path, scenario)
    policy, commissioning = scenario.twin.policy, scenario.commissioning
    # The windows of all runs are those of the scenario's policy.
    recording = replace(scenario.recording, window=commissioning.window, pre_trigger=commissioning.pre_trigger)
    own = scenario.twin.replace(policy=PAPER, k_dz=0.0, smoothing=None, k_noise=None, table=None)
    alone = scenario.replace(twin=own.replace(enabled=False), recording=recording, supervision=None)
    published, why = None, "it is this twin's policy"
    if (policy, paper_k_dz(scenario.twin)) != (PAPER, 1.0):
        try:
            ruled = scenario.replace(twin=own.replace(k_dz=1.0), recording=recording)
            TwinModel.of(ruled.model, ruled.twin)
            published, why = Column("paper's", "paper's dead zone", _POLICIES[PAPER], ruled), ""
        except InvalidInput as error:
            why = str(error)
    return Case(
        f"{scenario.name}: a machine that wears, alone and with its twin",
        " ".join(_story(scenario)),
        Column("alone", "without a twin", _ALONE, alone),
        Column(policy, f"{policy} twin", _explained(scenario), scenario),
        published,
        f"The paper's dead zone has no run of its own: {why}." if why else "",
    )


def _explained(scenario: st.Scenario) -> str:
    """Explain the scenario's twin."""
    policy, k_dz = scenario.twin.policy, paper_k_dz(scenario.twin)
    if policy != PAPER or k_dz == 1.0:
        return _POLICIES[policy]
    if k_dz == 0.0:
        return "the twin estimates the gap, and leaves the controller as it is (k_dz = 0)"
    return f"after each step a dead zone {k_dz:g} times as wide as the gap that the twin estimates"


def _check_story(path: Path, scenario: st.Scenario) -> None:
    if not scenario.twin.enabled:
        raise InvalidInput(
            f"{path}: twin.enabled = false: the demo shows the machine alone and with its twin; give true"
        )
    gap = as_pieces(scenario.gap, scenario.duration)
    if not gap.value(scenario.duration) > gap.value(0.0):
        raise InvalidInput(
            f"{path}: [gap]: does not grow within duration_s = {scenario.duration:g} s: the demo shows a machine that "
            "wears; give the first and the last gap (from_deg, to_deg) and over_s"
        )
    steps = reference_changes(scenario.reference, scenario.duration).size
    if not _FEWEST <= steps <= CHANGES * scenario.samples:
        given = f"has {steps or 'no'} step{'s' * (steps > 1)} in {scenario.duration:g} s"
        raise InvalidInput(
            f"{path}: [reference]: {given}: the demo compares steps that have time to come to rest; give at least "
            f'{_FEWEST}, such as kind = "square" with a shorter period_s than duration_s'
        )


def _story(scenario: st.Scenario) -> Iterator[str]:
    servo, gap = scenario.servo, as_pieces(scenario.gap, scenario.duration)
    first, last = (gap_in_words(servo, float(gap.value(time)), ".4g") for time in (0.0, scenario.duration))
    yield f"Scenario {scenario.name}: steps while the gap wears from {first} to {last} in {scenario.duration:g} s."
    if scenario.input_bias:
        yield f"Its input has a bias of {scenario.input_bias:g} {command_unit(servo)}."
