"""How many examples a random test draws: few and always the same in the suite, fresh ones and many in `make fuzz`."""

from typing import Any

from hypothesis import settings

FUZZ = 20
"""So many times as many."""


def examples(number: int, **others: Any) -> settings:
    """Settings of a test that draws so many examples in the suite."""
    fuzzing = settings.get_current_profile_name() == "fuzz"
    return settings(max_examples=number * FUZZ if fuzzing else number, **others)
