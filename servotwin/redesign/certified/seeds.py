"""Seed of the machines on which a setting is verified: it follows from the question alone."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from servotwin.plant.plants import Plant
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design, with_feedforward


def seed_of(servo: Plant, uncertainty: Uncertainty, setting: Design, seed: int) -> int:
    """Seed that depends on the whole question: equal ones are answered equally, others by other machines.

    A feedforward counts by what it leaves of the bias. Equal numbers are written alike, be they Python's, NumPy's or
    integers: caches take them for the same question.
    """
    fed = setting.controller.feedforward
    left = [f"{bias + fed + 0.0:.9g}" for bias in uncertainty.input_bias]
    rest = _own_numbers((with_feedforward(setting, 0.0), uncertainty.replace(input_bias=(0.0, 0.0))))
    question = repr((servo.version, rest, left, seed))
    return int.from_bytes(hashlib.sha256(question.encode()).digest()[:7], "big")


def _own_numbers(value: Any) -> Any:
    """The same value with Python's own numbers, a float wherever one may stand, and no negative zero."""
    if is_dataclass(value) and not isinstance(value, type):
        shown = [each for each in fields(value) if each.init]
        whole = [each.name for each in shown if type(each.default) is int]
        values = {each.name: getattr(value, each.name) for each in shown if each.name not in whole}
        return replace(value, **{name: _own_numbers(given) for name, given in values.items()})
    if isinstance(value, tuple):
        return tuple(map(_own_numbers, value))
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return float(value) + 0.0 if is_number else value
