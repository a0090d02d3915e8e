"""Claims, findings and verdicts; the fixed list of claims; the registry of measuring functions."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources

from servotwin.reproduction.runs import BIPOLAR, UNIPOLAR, Runs, Square


class Verdict(StrEnum):
    """Verdict of a measurement on a sentence of the paper."""

    REPRODUCED = "reproduced"
    NOT_AS_STATED = "not as stated"
    CANNOT_BE_CHECKED = "cannot be checked"


@dataclass(frozen=True, slots=True)
class Claim:
    """A sentence of the paper, its section, and the criterion that a measurement must meet to reproduce it.

    `amended`: reason for a criterion that was changed after a measurement; empty where it was not.
    """

    id: str
    sentence: str
    where: str
    criterion: str
    amended: str = ""


@dataclass(frozen=True, slots=True)
class Value:
    """A measured number with its unit ("" for counts and ratios)."""

    name: str
    number: float
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """A verdict, its reason, and the numbers behind it."""

    verdict: Verdict
    why: str
    values: tuple[Value, ...] = ()


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """One claim in one preset; `unipolar` is the same with a reference of 0/1 mm, where that matters (erratum E20)."""

    claim: Claim
    preset: str
    finding: Finding
    unipolar: Finding | None = None


Measure = Callable[[Runs, Square], Finding]


@dataclass(frozen=True, slots=True)
class _Measurement:
    """A claim's measuring function, its module, and `both`: measure both readings of the reference."""

    module: str
    function: Measure
    both: bool


_MEASURES: dict[str, _Measurement] = {}


def claims() -> tuple[Claim, ...]:
    """Read the list that was fixed in claims.toml before any measurement."""
    text = resources.files("servotwin.reproduction.claims").joinpath("claims.toml").read_text(encoding="utf-8")
    return tuple(Claim(**entry) for entry in tomllib.loads(text)["claim"])


def measures(claim_id: str) -> Callable[[Callable[[Runs], Finding]], Callable[[Runs], Finding]]:
    """Register the measuring function of a claim that does not depend on the square wave."""

    def register(function: Callable[[Runs], Finding]) -> Callable[[Runs], Finding]:
        _register(claim_id, function.__module__, lambda runs, _square: function(runs), both=False)
        return function

    return register


def measures_both(claim_id: str) -> Callable[[Measure], Measure]:
    """Register the measuring function of a claim that is also measured with the 0/1 mm square wave."""

    def register(function: Measure) -> Measure:
        _register(claim_id, function.__module__, function, both=True)
        return function

    return register


def _register(claim_id: str, module: str, function: Measure, *, both: bool) -> None:
    if claim_id in _MEASURES:
        raise ValueError(f"two measuring functions for claim {claim_id!r}")
    _MEASURES[claim_id] = _Measurement(module, function, both)


def group(claim: Claim) -> str:
    """Group of a claim; claims of one group share runs, and groups are measured separately."""
    return _MEASURES[claim.id].module


def measured_ids() -> frozenset[str]:
    """Ids of the claims that have a measuring function."""
    return frozenset(_MEASURES)


def measure(claim: Claim, runs: Runs) -> ClaimResult:
    """Measure a claim and decide its verdict."""
    how = _MEASURES[claim.id]
    other = how.function(runs, UNIPOLAR) if how.both else None
    return ClaimResult(claim, runs.preset, how.function(runs, BIPOLAR), other)


def decided(reproduced: bool, why: str, *values: tuple[str, float] | tuple[str, float, str]) -> Finding:
    """A finding from the criterion's truth; each value is (name, number) or (name, number, unit)."""
    verdict = Verdict.REPRODUCED if reproduced else Verdict.NOT_AS_STATED
    return Finding(verdict, why, listed(*values))


def listed(*values: tuple[str, float] | tuple[str, float, str]) -> tuple[Value, ...]:
    """Values from tuples, numbers as plain floats."""
    return tuple(Value(name, float(number), *unit) for name, number, *unit in values)
