"""`servotwin bench estimator`: what is shown and written of the figures."""

import json
import math

import pytest

from benchmarks import accuracy
from benchmarks.estimator_figures import Figure

FIGURES = [
    Figure("bias, deg", -0.001, (-0.005, 0.005), 20),
    Figure("share", 0.98, (1.0, 1.0), 500, "5 refused"),
    Figure("std, deg", 0.02, (0.0, 0.01), 20),
    Figure("reported only", math.nan, (-math.inf, math.inf), 3),
    Figure("times better", 94.0, (20.0, math.inf), 20),
]


def test_targets_in_words() -> None:
    assert [accuracy.target(f) for f in FIGURES] == ["-0.005 .. 0.005", ">= 1", "<= 0.01", "", ">= 20"]


def test_document(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy, "table", lambda _size: iter(FIGURES))
    output = tmp_path / "accuracy.json"
    accuracy.accuracy("2026-11-21", output, 0.5)
    document = json.loads(output.read_text())
    assert document["schema"] == accuracy.SCHEMA
    assert [row["met"] for row in document["figures"]] == [True, False, False, None, True]
    assert document["figures"][3]["value"] is None
