"""Documents of the benchmarks: JSON that every reader accepts, and none without an output."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks import report
from servotwin.errors import InvalidInput


def test_what_is_not_finite_is_null_and_numbers_of_numpy_are_numbers() -> None:
    values = [1.5, math.nan, math.inf, np.float64(2.5), np.float64("nan"), np.int64(3), np.bool_(True)]
    text = report.text("schema/1", "2026-11-21", values=values)
    found = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found["values"] == [1.5, None, None, 2.5, None, 3, True]
    assert (found["schema"], found["date"]) == ("schema/1", "2026-11-21")
    assert found["machine"]["cores"] >= 1


def test_it_is_written_only_where_it_is_wanted(tmp_path: Path) -> None:
    with Console().capture() as nothing:
        report.write(None, "text", Console())
    assert nothing.get() == ""
    report.write(tmp_path / "a.json", "text", Console())
    assert (tmp_path / "a.json").read_text() == "text"
    report.check(None)
    with pytest.raises(InvalidInput, match="json"):
        report.check(tmp_path / "a.txt")
