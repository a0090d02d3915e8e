"""`servotwin bench hostile`: what is shown and written of machines and their twins."""

import io
import json
from collections import Counter

import pytest
from rich.console import Console

from benchmarks import alone, hostile, hostile_command
from benchmarks.hostile import HostileOutcome
from benchmarks.hostiletwin import TwinFault
from servotwin.errors import InvalidInput
from servotwin.messages import Cause, Reason

WORST = {TwinFault.SILENT: 0.5, TwinFault.LIES_HIGH: 1.5, TwinFault.LIES_LOW: 0.25, TwinFault.REPLAYS: 0.75}


def fake(seed: int, kind: TwinFault, friction: bool) -> HostileOutcome:
    fallbacks = (Cause.SILENCE,) if kind is TwinFault.SILENT else ()
    refused = Counter({Reason.OLD_DATA: 2, Reason.EXPIRED: seed})
    return HostileOutcome(kind, hostile.case(seed, friction), WORST[kind], 0.0, True, seed, fallbacks, refused)


def text_of(text: Console) -> str:
    return text.file.getvalue()


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.setattr(
        hostile_command, "shared", lambda _function, tasks: ((task, fake(*task)) for task in reversed(tasks))
    )
    console, output = Console(file=io.StringIO(), width=100), tmp_path / "hostile.json"
    outcomes = hostile_command.hostile_twins("2026-11-21", output, 8, console=console)
    return outcomes, text_of(console), json.loads(output.read_text())


@pytest.mark.slow
def test_every_kind_has_its_row_in_the_order_of_the_kinds(found) -> None:
    outcomes, text, _ = found
    assert [outcome.kind for outcome in outcomes] == [*hostile.KINDS, *hostile.KINDS, hostile.KINDS[0]]
    rows = {kind: next(line.split() for line in text.splitlines() if line.startswith(kind.value)) for kind in WORST}
    assert rows[TwinFault.LIES_HIGH][-5:] == ["2", "1.50", "2", "6", "0"]
    assert rows[TwinFault.SILENT][-5:] == ["2", "0.50", "0", "4", "2"]
    rubbing = next(line.split() for line in text.splitlines() if line.startswith(hostile_command.FRICTION))
    assert rubbing[-5:] == ["1", "0.50", "0", "0", "1"]
    assert f"6 of 8 machines as stated stay within {1e3 * hostile.band().error:.3g} mm" in text


def test_the_document_says_the_same(found) -> None:
    outcomes, _, document = found
    assert document["schema"] == hostile_command.SCHEMA
    assert document["band"]["error_m"] == hostile.band().error
    assert [row["worst_bands"] for row in document["outcomes"]] == [outcome.worst for outcome in outcomes]
    assert [row["friction_n_m"] > 0.0 for row in document["outcomes"]] == [False] * 8 + [True]
    assert document["outcomes"][0]["fallbacks"] == ["the twin is silent"]


def test_it_stands_alone() -> None:
    for names, others in ((("hostile", "W1"), False), (("hostile",), True), (("estimator", "hostile"), False)):
        with pytest.raises(InvalidInput, match="stands alone"):
            alone.run_alone(names, "", None, True, others)
    assert not alone.run_alone(("W1",), "", None, True, True)
