"""The check that every number in the estimators' settings must pass."""

from __future__ import annotations

import math

from servotwin.errors import InvalidInput


def check_number(name: str, value: object, whole: bool = False, positive: bool = False) -> None:
    """Refuse what is no finite number of at least 0, or, as asked for, no whole one, or 0 itself.

    Raises
    ------
    InvalidInput
        Naming the setting, its value and what is allowed.
    """
    number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else value
    if (whole and not isinstance(value, int)) or not 0.0 <= number < math.inf or (positive and number == 0.0):
        what = "whole number" if whole else "finite number"
        raise InvalidInput(f"{name} = {value!r}: must be a {what} {'above' if positive else 'of at least'} 0")
