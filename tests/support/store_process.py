"""A process that writes to a store until it is killed, and says what is safe.

put     windows of servos s0 to s3 from sequence 0 on, through a group commit, from four threads: "NEW s0 17"
work    claims, and commits an outcome with one piece of evidence and one letter for each message: "DONE 3"
hold    claims, says what it has ("HELD 5 s0"), and never comes back
"""

import itertools
import os
import threading
import time
from multiprocessing.connection import Connection

from store_cases import outcome, window

from servotwin.store.group_commit import GroupCommit
from servotwin.store.records import EvidenceRecord, Lease, WorkResult
from servotwin.store.store import Store, open_store

LEASE_S = 2.0
BODY = bytes(range(256)) * 8
SERVOS = ("s0", "s1", "s2", "s3")


class Output:
    """Lines that another process reads."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe, self._telling = pipe, threading.Lock()

    def tell(self, *words: object) -> None:
        with self._telling:
            os.write(self._pipe.fileno(), (" ".join(map(str, words)) + "\n").encode())


def put_all(group: GroupCommit, servo: str, output: Output) -> None:
    for sequence in itertools.count():
        output.tell(group.put(window(servo, sequence, BODY)).result().name, servo, sequence)


def worked(claim: Lease) -> WorkResult:
    evidence = [EvidenceRecord("estimate", message.id, b"seen") for message in claim.messages]
    letters = tuple(b"about %d" % message.id for message in claim.messages)
    return outcome(claim, *evidence, outgoing=letters)


def work(store: Store, group: GroupCommit, owner: str, output: Output) -> None:
    while True:
        claims = store.lease(owner, 2, LEASE_S, time.time(), per_servo=5)
        futures = [group.commit(worked(claim)) for claim in claims]
        output.tell("DONE", sum(future.result() for future in futures))
        if not claims:
            time.sleep(0.01)


def hold(store: Store, owner: str, output: Output) -> None:
    for claim in store.lease(owner, 2, LEASE_S, time.time(), per_servo=5):
        output.tell("HELD", claim.servo, len(claim.messages))
    threading.Event().wait()


def main(role: str, url: str, pipe: Connection) -> None:
    """Run in a role until the process is killed."""
    store, output = open_store(url), Output(pipe)
    group, owner = GroupCommit(store), f"process {os.getpid()}"
    if role == "put":
        for servo in SERVOS:
            threading.Thread(target=put_all, args=(group, servo, output)).start()
    elif role == "work":
        work(store, group, owner, output)
    else:
        hold(store, owner, output)
