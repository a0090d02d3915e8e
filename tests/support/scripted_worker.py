"""A worker that does what the body of a window's channel says: "die", "hang", "raise", "fill", or its work."""

import os
import sys
import time

from servotwin.messages import decode
from servotwin.store.records import EvidenceRecord, Lease, WorkResult
from servotwin.twin_service import worker

ABANDON_AFTER = 3


def work(claim: Lease, now: float, _urgency: object) -> WorkResult:
    """One piece of evidence for each message; a message that others died of is given up."""
    messages = claim.messages[:1] if claim.attempts > 1 else claim.messages
    evidence = []
    for message in messages:
        behaviour = decode(message.body).reason
        if claim.attempts >= ABANDON_AFTER:
            evidence.append(EvidenceRecord("estimate", message.id, b"\xc0", status="failed: given up"))
            continue
        if behaviour == "die":
            os._exit(9)
        if behaviour == "hang":
            time.sleep(600.0)
        if behaviour == "raise":
            raise ValueError("this one cannot be worked on")
        if behaviour == "fill":
            bytearray(2_000_000_000)
        evidence.append(EvidenceRecord("estimate", message.id, b"\xc0", status=f"at {now:.0f}"))
    done = tuple(message.id for message in messages)
    sent = tuple(b"news" for _ in messages)
    return WorkResult(claim.servo, claim.serial, claim.state + b"x" * len(done), None, done, tuple(evidence), sent)


if __name__ == "__main__":
    worker._load_work = lambda _start: work
    worker.main(int(sys.argv[1]))
