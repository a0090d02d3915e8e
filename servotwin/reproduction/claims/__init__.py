"""The paper's claims: a list fixed in claims.toml before measuring, and a measuring function for each."""

from servotwin.reproduction.claims import backlash, linear, loop, noise, observer  # they register their functions
from servotwin.reproduction.claims.claim import (
    Claim,
    Finding,
    Result,
    Value,
    Verdict,
    claims,
    group,
    measure,
    measured_ids,
)

__all__ = [
    "Claim",
    "Finding",
    "Result",
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
