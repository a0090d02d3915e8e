"""Summary of a certificate, as an update carries it."""

from __future__ import annotations

from servotwin.messages import Verification
from servotwin.redesign.certified.certificate import Certificate


def verification_of(certificate: Certificate) -> Verification:
    """Summarise a certificate for an update, without its computing time: equal twins send equal bytes."""
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
        settled_least=certificate.settled_least,
        confidence=certificate.confidence if certificate.settled_least else 0.0,
        Ms_worst=0.0 if certificate.loop is None else certificate.loop.Ms_worst,
        phase_margin_worst=0.0 if certificate.loop is None else certificate.loop.phase_margin_worst,
    )
