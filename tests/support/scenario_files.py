"""A short scenario as TOML, loaded or refused."""

import pytest

from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput

SHORT = """
servo = "paper"
duration_s = 5.0
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 10.0
"""
PAPER = "[twin]\npolicy = 'paper'\nmethod = 'paper'\n"


def load(tmp_path, text):
    path = tmp_path / "wear.toml"
    path.write_text(text, encoding="utf-8")
    return Scenario.load(path)


def refusal(tmp_path, text):
    with pytest.raises(InvalidInput) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert "wear.toml" in message
    assert "\n" not in message
    return message
