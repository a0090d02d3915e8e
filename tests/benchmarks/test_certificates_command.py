"""Certified settings on fresh machines: peaks against the model's own, the rows, the document."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import certificates
from benchmarks.certificates import CertificateRow, questions, shown, worst_peak
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.uncertainty import Uncertainty

SERVO = Servo.preset("paper")


def test_the_worst_peak_of_exact_plants_is_that_of_the_model() -> None:
    exact = Uncertainty(k=0.0, c=0.0, k_B=0.0, m=0.0)
    law = SERVO.controller.replace(Ki=0.0, integral_only=True)
    assert worst_peak(SERVO, exact, law, 3, 0) == pytest.approx(SERVO.margins(law).Ms, rel=1e-4)
    with_integral = law.replace(Ki=SERVO.controller.Ki)
    peaks = [SERVO.margins(law.replace(Ki=Ki, integral_only=False)).Ms for Ki in (0.0, SERVO.controller.Ki)]
    assert worst_peak(SERVO, exact, with_integral, 3, 0) == pytest.approx(max(peaks), rel=1e-4)


def test_delays_count_for_a_sampled_law() -> None:
    law = SERVO.controller.replace(Ki=0.0, sample_rate=50.0)
    peaks = [worst_peak(SERVO, Uncertainty(k=0.0, c=0.0, k_B=0.0, m=0.0, delay=late), law, 1, 0) for late in (0, 3)]
    assert peaks[0] < peaks[1]


@pytest.mark.slow
def test_rows_are_shown_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = {"gap of 10 deg": questions(SERVO)["gap of 10 deg"]}
    monkeypatch.setattr(certificates, "questions", lambda _servo: some)
    path = tmp_path / "certificates.json"
    rows = certificates.certificates("today", path, 8, Console(quiet=True), ("paper",), seed=3)
    assert [row.rate for row in rows] == [None, certificates.RATE]
    for row in rows:
        assert row.settled == row.machines == 8
        assert row.least == pytest.approx(0.05 ** (1.0 / 8.0))
        assert 1.0 < row.Ms <= row.Ms_certified * 1.01
    assert [each["settled"] for each in json.loads(path.read_text())["rows"]] == [8, 8]


def test_a_refusal_is_a_row_with_its_reason() -> None:
    row = CertificateRow("paper", "gap of 10 deg", None, "none of 3 candidates is verified")
    assert math.isnan(row.Ms)
    assert list(shown([row]).columns[1].cells)[-1] == row.refused
