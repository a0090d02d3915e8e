"""The table of what each axis preset can do, against the code."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.basis import BacklashKind
from servotwin.redesign.registry import policy_of
from servotwin.twin.estimating import estimator_of, known_machine, motor_learning_of
from servotwin.twin.settings import TriageSettings, TwinSettings
from servotwin.twin.triage import Triage

PAGE = Path(__file__).parents[2] / "docs" / "axis-presets.md"
HEAD = "| preset | estimate of the gap | `paper`, `hysteresis` | `certified` | learns its model | triage |"


def rows() -> dict[str, list[str]]:
    lines = PAGE.read_text().splitlines()
    first = lines.index(HEAD) + 2
    last = lines.index("", first)
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[first:last]]
    return {name.strip("`"): rest for name, *rest in cells}


def said(make: Callable[[], object]) -> str:
    """Word of the table for what is made or refused."""
    try:
        made = make()
    except InvalidInput:
        return "no"
    return "no" if made is None else "yes"


def learnt(axis: Axis, settings: TwinSettings) -> str:
    """Word of the table for the numbers of an axis that are learnt."""
    if known_machine(axis, settings) is None:
        return "no"
    if axis.backlash_kind is BacklashKind.FREE:
        return "stiffness and damping of the shaft"
    return "the ratio" if motor_learning_of(axis, settings) is None else "yes"


def test_the_table_has_every_preset() -> None:
    assert set(rows()) == set(AXES)


@pytest.mark.parametrize("name", rows())
def test_each_preset_can_do_what_the_table_says(name: str) -> None:
    axis, (estimate, zones, certified, learns, triage) = Axis.preset(name), rows()[name]
    settings = TwinSettings(policy="paper")
    assert estimate.split(",")[0] == said(lambda: estimator_of(axis, settings))
    for policy in ("paper", "hysteresis"):
        assert zones.split(",")[0] == said(partial(policy_of, axis, TwinSettings(policy=policy)))
    assert learns == learnt(axis, settings)
    assert triage == said(lambda: Triage.of(axis, TriageSettings()))
    assert certified.split(",")[0] == said(lambda: policy_of(axis, TwinSettings()))
