"""Settings of random axes: verified, simulated on fresh machines, and shown with what was refused."""

from __future__ import annotations

import pytest
from rich.console import Console

from benchmarks.random_settings import BATCH


@pytest.mark.slow
def test_settings_are_judged_and_shown() -> None:
    (key, task), *_ = BATCH.units(("velocity",), 1, 78)
    numbers = BATCH.measure(task)
    assert numbers["settled"] >= 198
    assert not numbers["opens"]
    assert numbers["cost"] > 0.0
    console = Console(width=120, record=True)
    BATCH.show({key: numbers, "78/torque/1": {"refused": "no setting"}}, console)
    text = console.export_text()
    assert "78/torque/1: no setting" in text
    assert text.count("78/") == 1
