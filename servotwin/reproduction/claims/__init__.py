"""The paper's claims: a list fixed in claims.toml before measuring, and a measuring function for each."""

from servotwin.reproduction.claims import backlash, linear, loop, noise, observer  # they register their functions
from servotwin.reproduction.claims.registry import (
    Claim,
    ClaimResult,
    Finding,
    Value,
    Verdict,
    claims,
    group,
    measure,
    measured_ids,
)

__all__ = [
    "Claim",
    "ClaimResult",
    "Finding",
    "Value",
    "Verdict",
    "backlash",
    "claims",
    "group",
    "linear",
    "loop",
    "measure",
    "measured_ids",
    "noise",
    "observer",
]
