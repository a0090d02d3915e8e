"""The README's verdicts are what is measured."""

import re
from functools import cache
from pathlib import Path

import pytest

from servotwin.plant.servo import PRESETS
from servotwin.reproduction import claims
from servotwin.reproduction.claims import Verdict, registry
from servotwin.reproduction.runs import Runs

README = (Path(__file__).parents[2] / "README.md").read_text()
ROWS = re.findall(r"^\|[^|]+\| `([\w-]+)` \| (\w+) \| (\w+) \| (\w+) \|", README, re.MULTILINE)
WORDS = {Verdict.REPRODUCED: "yes", Verdict.NOT_AS_STATED: "no"}
LISTED = {claim.id: claim for claim in claims.claims()}


@cache
def runs(preset):
    return Runs(preset)


def test_the_table_is_found():
    assert len(ROWS) >= 10


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_verdicts_are_measured(row, monkeypatch):
    """Of the square wave of +-1 mm: the table says nothing of the other reading, so nothing is run for it."""
    monkeypatch.setattr(registry, "UNIPOLAR", registry.BIPOLAR)
    claim, *said = row
    assert [WORDS[claims.measure(LISTED[claim], runs(preset)).finding.verdict] for preset in PRESETS] == said
