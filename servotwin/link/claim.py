"""One live edge per servo: the edge's claim, and the transport that sends nothing without it.

A folder that was copied runs two edges with one token. Each run of an edge claims its servo once, when it begins; the
newest claim counts. The edge that was superseded sends nothing more, keeps its windows, and asks at every later try
whether it still is, which the twin reports as a conflict. `servotwin.messages.claims` has the protocol.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Protocol

from servotwin.link.transport import Parcel, Refused, Transport, Unreachable
from servotwin.messages import PROTOCOL, ClaimStatus, EdgeClaim, Refusal
from servotwin.messages.checks import LARGEST_REPORTED, NAME_PATTERN
from servotwin.messages.claims import CLONED

SUPERSEDED = "another edge of this servo runs and has taken over: end one of the two, and start the other one again"
_OF_THE_SENDER = (Refusal.BAD_TOKEN, Refusal.UNKNOWN_SERVO, Refusal.TOO_MANY, Refusal.UNAVAILABLE, Refusal.SUPERSEDED)
"""Refusals of a claim that hold for every message of its sender."""
_TRIES = 8
"""Claims in a row that others may win: each run of an edge claims once."""


class ClaimingTransport(Transport, Protocol):
    """A transport whose requests name a claim.

    Attributes
    ----------
    claim : HeldClaim
        Named by every request from now on.
    """

    claim: HeldClaim

    def ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        """Send a question or a claim; None: the twin is of a version without claims.

        Raises
        ------
        Refused
        Unreachable
        """


@dataclass(frozen=True, slots=True)
class HeldClaim:
    """Claim that an edge holds.

    Parameters
    ----------
    run : str
        Name of the edge's run.
    number : int
        0: none.
    """

    run: str = ""
    number: int = 0

    @property
    def text(self) -> str:
        """Text that a request carries; empty: no claim is held."""
        return f"{self.number} {self.run}" if self.number else ""

    @staticmethod
    def from_text(text: str) -> HeldClaim | None:
        """Read a claim as `text` writes it; None: it is none."""
        number, _, run = text.partition(" ")
        if not (number.isascii() and number.isdecimal() and len(number) <= 16 and re.match(NAME_PATTERN, run)):
            return None
        return HeldClaim(run, int(number)) if int(number) <= LARGEST_REPORTED else None


@dataclass(frozen=True, slots=True)
class FormerRuns:
    """Earlier runs of an edge, as its folder knows them.

    Parameters
    ----------
    claim : HeldClaim
        The last one that was stored.
    last : str
        The last run, which may have ended before its claim was stored; empty: not known.
    """

    claim: HeldClaim
    last: str

    def knows(self, status: ClaimStatus) -> bool:
        """True where the newest claim is of one of them, of a copy of one that ran, or older, as of a twin that was
        restored from a backup."""
        return status.number <= self.claim.number or status.run in (self.claim.run, self.last, CLONED)


class ExclusiveTransport:
    """Transport that claims the servo before its first message, and sends nothing once another run has claimed it.

    Parameters
    ----------
    transport : ClaimingTransport
    servo : str
    held : HeldClaim
        Name of this run; with a number where an earlier link process of the same run has claimed.
    store : callable
        Called with a new claim, to be stored before it is used.
    software : str
        Version of servotwin, for the twin.
    former : FormerRuns, optional
        What the edge's folder knows of earlier runs.

    Attributes
    ----------
    superseded : bool
        Another edge has taken over.
    behind : str
        Run that has claimed the servo since the edge's folder was written, as where an older copy of it was put back;
        empty: there is none.
    twin : ClaimStatus or None
        The twin's last answer; None: there was none, or the twin is of a version without claims.
    """

    def __init__(
        self,
        transport: ClaimingTransport,
        servo: str,
        held: HeldClaim,
        store: Callable[[HeldClaim], None] = lambda _: None,
        software: str = "",
        former: FormerRuns | None = None,
    ) -> None:
        self._transport, self._servo, self._store, self._software = transport, servo, store, software
        self._held, self._confirmed, self._lock, self._former = held, False, Lock(), former
        self.superseded, self.behind = False, ""
        self.twin: ClaimStatus | None = None

    def deliver(self, parcel: Parcel) -> float:
        """Send a message; raises Refused (SUPERSEDED) where another edge has taken over."""
        self._confirm()
        try:
            return self._transport.deliver(parcel)
        except (Refused, Unreachable) as error:
            self._failed(error)
            if isinstance(error, Refused) and error.reason is Refusal.NOT_UNDERSTOOD and self._twin_is_older:
                # To that twin a field or a reason that came later is an error. It will know it once it is upgraded.
                raise Refused(Refusal.UNKNOWN_SCHEMA, str(error), error.after_s) from None
            raise

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:
        """Return the twin's messages; raises Refused (SUPERSEDED) where another edge has taken over."""
        self._confirm()
        try:
            return self._transport.listen(after, at_once)
        except (Refused, Unreachable) as error:
            self._failed(error)
            raise

    def listen_anew(self) -> None:
        """End a `listen` under way; see `Transport`."""
        self._transport.listen_anew()

    @property
    def claim(self) -> HeldClaim:
        """The claim that requests name; without number: the servo is not claimed, or the twin knows no claims."""
        return self._transport.claim

    def close(self) -> None:
        """Close the connections at once."""
        self._transport.close()

    @property
    def _twin_is_older(self) -> bool:
        return self.twin is None or self.twin.protocol < PROTOCOL

    def _failed(self, error: Refused | Unreachable) -> None:
        """Ask again: the claim may not count any more, or the twin may be of another version when it is back."""
        superseded = isinstance(error, Refused) and error.reason is Refusal.SUPERSEDED
        if superseded or isinstance(error, Unreachable):
            self._confirmed = False
        if superseded:
            self._confirm()

    def _confirm(self) -> None:
        with self._lock:
            if self._confirmed:
                return
            if self.superseded:  # for ever: an edge that took over again by itself would do so in turns with the other
                self._ask(0)
                raise Refused(Refusal.SUPERSEDED, SUPERSEDED)
            self._claim()
            self._confirmed = True

    def _claim(self) -> None:
        status = self._ask(0)
        for _ in range(_TRIES):
            if status is None:
                self._transport.claim = HeldClaim()
                return
            if self._held.number and status.run != self._held.run and status.number >= self._held.number:
                self.superseded = True
                raise Refused(Refusal.SUPERSEDED, SUPERSEDED)
            if self._held.number or status.run == self._held.run:
                # A number below ours: the twin was restored from a backup, and takes ours over from our next request.
                self._hold(max(status.number, self._held.number))
                return
            if self._former is not None and not self._former.knows(status):
                self.behind = status.run
            status = self._ask(status.number + 1)
        raise Unreachable("others claim this servo all the time")

    def _hold(self, number: int) -> None:
        held = HeldClaim(self._held.run, number)
        if held != self._held:
            self._store(held)
        self._held = self._transport.claim = held

    def _ask(self, takes: int) -> ClaimStatus | None:
        behind = bool(takes and self.behind) and not self._twin_is_older  # to which a later field is an error
        question = EdgeClaim(self._servo, self._held.run, self._held.number, takes, PROTOCOL, self._software, behind)
        try:
            self.twin = self._transport.ask(question)
        except Refused as error:
            if error.reason in _OF_THE_SENDER:
                raise
            # Of the claim, which may have been changed on its way: no reason to drop the message that waits for it.
            raise Unreachable(f"the twin does not take this edge's claim: {error}") from None
        return self.twin
