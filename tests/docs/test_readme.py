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
MEASURED = {"always-restabilised", "wider-range-than-fixed", "settling-lengthened", "pd-bandwidth", "lost-near-17"}
"""Claims over many runs, or over all PDs; tests/cosim and tests/reproduction have one run of what they rest on."""
DEAR = pytest.mark.exploration
LISTED = {claim.id: claim for claim in claims.claims()}


@cache
def runs(preset):
    return Runs(preset)


def test_the_table_is_found():
    assert len(ROWS) >= 10


@pytest.mark.slow
@pytest.mark.parametrize(
    "row", [pytest.param(row, id=row[0], marks=DEAR if row[0] in MEASURED else ()) for row in ROWS]
)
def test_verdicts_are_measured(row, monkeypatch):
    """Of the square wave of +-1 mm: the table says nothing of the other reading, so nothing is run for it."""
    monkeypatch.setattr(registry, "UNIPOLAR", registry.BIPOLAR)
    claim, *said = row
    assert [WORDS[claims.measure(LISTED[claim], runs(preset)).finding.verdict] for preset in PRESETS] == said
