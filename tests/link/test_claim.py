"""One live edge per servo: the newer run takes over, the older sends nothing more, whatever is restarted."""

import pytest

from servotwin.link.claim import ExclusiveTransport, FormerRuns, HeldClaim
from servotwin.link.outbox import MemoryOutbox
from servotwin.link.session import Sender, Session
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import PROTOCOL, ClaimStatus, EdgeClaim, Refusal


class Twin:
    """What the twin does with claims, in memory."""

    def __init__(self) -> None:
        self.newest = ClaimStatus("axis")
        self.claims: list[EdgeClaim] = []
        self.has_claims = self.there = True

    def ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        self.claims.append(claim)
        if not self.there:
            raise Unreachable("away")
        if not self.has_claims:
            return None
        if claim.takes == self.newest.number + 1:
            self.newest = ClaimStatus("axis", claim.run, claim.takes, self.newest.protocol)
        return self.newest

    def admit(self, held: HeldClaim) -> None:
        if not self.there:
            raise Unreachable("away")
        if held.number > self.newest.number:
            self.newest = ClaimStatus("axis", held.run, held.number)
        if held.number and (held.run, held.number) != (self.newest.run, self.newest.number):
            raise Refused(Refusal.SUPERSEDED, "superseded")


class Line:
    """A transport of one edge to that twin."""

    def __init__(self, twin: Twin) -> None:
        self.twin, self.claim, self.sent = twin, HeldClaim(), 0
        self.refusal: Refused | None = None

    def ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        return self.twin.ask(claim)

    def deliver(self, _parcel: Parcel) -> float:
        self.twin.admit(self.claim)
        if self.refusal is not None:
            raise self.refusal
        self.sent += 1
        return 0.0

    def listen(self, _after: int, at_once: bool = False) -> list[bytes]:  # noqa: ARG002
        self.twin.admit(self.claim)
        return []

    def listen_anew(self) -> None:
        pass

    def close(self) -> None:
        pass


PARCEL = Parcel("axis", b"body")


def edge(twin: Twin, run: str, number: int = 0) -> tuple[ExclusiveTransport, list[HeldClaim]]:
    stored: list[HeldClaim] = []
    return ExclusiveTransport(Line(twin), "axis", HeldClaim(run, number), stored.append, "1.2"), stored


@pytest.mark.parametrize(
    ("newest", "behind"),
    [
        (ClaimStatus("axis", "b3-cc", 3, PROTOCOL), ""),  # its last run was killed before it stored its claim
        (ClaimStatus("axis", "b2-bb", 2, PROTOCOL), ""),
        (ClaimStatus("axis", "b1-zz", 1, PROTOCOL), ""),  # a twin that was restored from a backup
        (ClaimStatus("axis", "", 0, PROTOCOL), ""),
        (ClaimStatus("axis", "b3-zz", 3, PROTOCOL), "b3-zz"),
        (ClaimStatus("axis", "b3-zz", 3, PROTOCOL - 1), "b3-zz"),  # which would not understand it
    ],
)
def test_a_folder_that_does_not_know_the_run_before_is_behind(newest: ClaimStatus, behind: str) -> None:
    twin = Twin()
    twin.newest = newest
    former = FormerRuns(HeldClaim("b2-bb", 2), "b3-cc")
    one = ExclusiveTransport(Line(twin), "axis", HeldClaim("b4-dd"), software="1.2", former=former)
    one.deliver(PARCEL)
    assert one.behind == behind
    assert [claim.behind for claim in twin.claims] == [False, bool(behind) and newest.protocol == PROTOCOL]


@pytest.mark.parametrize("reason", list(Refusal))
def test_a_claim_that_is_refused_drops_no_message(reason: Refusal) -> None:
    """As one that a proxy has changed on its way: the message itself has not been judged."""
    twin, outbox = Twin(), MemoryOutbox()
    outbox.put_letter(b"letter")

    class Refusing(Line):
        def ask(self, claim: EdgeClaim) -> ClaimStatus | None:  # noqa: ARG002
            raise Refused(reason, "as told")

    Sender(Session(outbox), ExclusiveTransport(Refusing(twin), "axis", HeldClaim("b1-aa"))).step(0.0)
    assert len(outbox.letters()) == 1


def test_an_edge_claims_before_its_first_message_and_once() -> None:
    twin = Twin()
    one, stored = edge(twin, "b1-aa")
    for _ in range(3):
        one.deliver(PARCEL)
        one.listen(0)
    assert stored == [HeldClaim("b1-aa", 1)]
    assert [claim.takes for claim in twin.claims] == [0, 1]
    assert (twin.claims[0].protocol, twin.claims[0].software) == (PROTOCOL, "1.2")


def test_the_newer_run_takes_over_and_the_older_sends_nothing_more_for_ever() -> None:
    twin = Twin()
    older, _ = edge(twin, "b1-aa")
    older.deliver(PARCEL)
    newer, _ = edge(twin, "b1-bb")
    newer.deliver(PARCEL)
    for _ in range(3):
        with pytest.raises(Refused, match="another edge of this servo") as refused:
            older.deliver(PARCEL)
        assert refused.value.reason is Refusal.SUPERSEDED
        with pytest.raises(Refused, match="another edge of this servo"):
            older.listen(0)
        newer.deliver(PARCEL)
    assert older.superseded
    assert not newer.superseded
    assert (older._transport.sent, newer._transport.sent) == (1, 4)
    # It tells, at each try, that it still runs: by this the twin knows a conflict from a restart.
    assert twin.claims[-1] == EdgeClaim("axis", "b1-aa", 1, 0, PROTOCOL, "1.2")


def test_a_restarted_link_process_of_the_same_run_keeps_the_claim() -> None:
    twin = Twin()
    edge(twin, "b1-aa")[0].deliver(PARCEL)
    again, stored = edge(twin, "b1-aa", 1)
    again.deliver(PARCEL)
    assert (twin.newest.number, stored) == (1, [])


def test_a_restarted_link_process_of_a_superseded_run_stays_superseded() -> None:
    twin = Twin()
    edge(twin, "b1-aa")[0].deliver(PARCEL)
    edge(twin, "b1-bb")[0].deliver(PARCEL)
    again, _ = edge(twin, "b1-aa", 1)
    with pytest.raises(Refused):
        again.deliver(PARCEL)
    assert twin.newest.run == "b1-bb"


def test_a_restarted_edge_takes_over_from_its_former_run() -> None:
    twin = Twin()
    edge(twin, "b1-aa")[0].deliver(PARCEL)
    after, stored = edge(twin, "b2-cc")
    after.deliver(PARCEL)
    assert stored == [HeldClaim("b2-cc", 2)]


def test_a_claim_that_is_repeated_later_changes_nothing() -> None:
    twin = Twin()
    edge(twin, "b1-aa")[0].deliver(PARCEL)
    recorded = list(twin.claims)
    newer, _ = edge(twin, "b1-bb")
    newer.deliver(PARCEL)
    for claim in recorded:
        twin.ask(claim)
    newer.deliver(PARCEL)
    assert twin.newest.run == "b1-bb"


def test_a_twin_restored_from_a_backup_takes_the_claim_over_from_the_edge() -> None:
    twin = Twin()
    for run in ("b1-aa", "b2-bb", "b3-cc"):
        one, _ = edge(twin, run)
        one.deliver(PARCEL)
    twin.newest = ClaimStatus("axis", "b1-aa", 1)
    one.deliver(PARCEL)
    assert twin.newest == ClaimStatus("axis", "b3-cc", 3)


def test_a_twin_without_claims_gets_messages_and_is_asked_again_after_it_was_away() -> None:
    twin = Twin()
    twin.has_claims = False
    one, stored = edge(twin, "b1-aa")
    one.deliver(PARCEL)
    assert stored == []
    twin.there = False
    with pytest.raises(Unreachable):
        one.deliver(PARCEL)
    twin.there = twin.has_claims = True
    one.deliver(PARCEL)
    assert stored == [HeldClaim("b1-aa", 1)]


@pytest.mark.parametrize(("protocol", "kept"), [(None, True), (1, True), (PROTOCOL, False)])
def test_what_an_older_twin_does_not_understand_is_kept(protocol: int | None, kept: bool) -> None:
    twin = Twin()
    twin.has_claims = protocol is not None
    twin.newest = ClaimStatus("axis", protocol=protocol or 1)
    outbox = MemoryOutbox()
    outbox.put_letter(b"letter")
    session = Session(outbox)
    one, _ = edge(twin, "b1-aa")
    one._transport.refusal = Refused(Refusal.NOT_UNDERSTOOD, "Invalid enum value")
    sender = Sender(session, one)
    sender.step(0.0)
    assert bool(outbox.letters()) is kept
    assert not list(session.due(599.0))
    one._transport.refusal = None
    sender.step(601.0)
    assert outbox.letters() == []
    assert one._transport.sent == (1 if kept else 0)


@pytest.mark.parametrize(
    "text",
    ["", "7", "x b1", "-1 b1", "1 ", "99999999999999999999 b1", f"{2**52 + 1} b1", "1 b\0", "1 b b", f"1 {'b' * 65}"],
)
def test_a_text_that_is_no_claim_is_none(text: str) -> None:
    assert HeldClaim.from_text(text) is None
    assert HeldClaim.from_text(HeldClaim("b1-aa", 7).text) == HeldClaim("b1-aa", 7)
