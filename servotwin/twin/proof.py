"""A certificate as it is sent."""

from __future__ import annotations

from servotwin.messages import Verification
from servotwin.redesign.certified.certificate import Certificate


def verification_of(certificate: Certificate) -> Verification:
    """What an update says of its setting; what it took is no part of it, so that equal twins send equal bytes."""
    return Verification(
        members=certificate.members,
        looked_at=certificate.looked_at,
        settled=certificate.settled,
        tail=certificate.tail,
        overshoot=certificate.overshoot,
        Ms=certificate.Ms,
        crossover=certificate.crossover,
        phase_margin=certificate.phase_margin,
        saturated=certificate.saturated,
    )
