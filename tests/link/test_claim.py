"""One live edge per servo: the newer run takes over, the older sends nothing more, whatever is restarted."""

import pytest

from servotwin.link.claim import ExclusiveTransport, Held, held_of
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import PROTOCOL, EdgeClaim, Refusal, Standing


class Twin:
    """What the twin does with claims, in memory."""

    def __init__(self) -> None:
        self.newest = Standing("axis")
        self.claims: list[EdgeClaim] = []
        self.has_claims = self.there = True

    def ask(self, claim: EdgeClaim) -> Standing | None:
        self.claims.append(claim)
        if not self.there:
            raise Unreachable("away")
        if not self.has_claims:
            return None
        if claim.takes == self.newest.number + 1:
            self.newest = Standing("axis", claim.run, claim.takes)
        return self.newest

    def admit(self, held: Held) -> None:
        if not self.there:
            raise Unreachable("away")
        if held.number > self.newest.number:
            self.newest = Standing("axis", held.run, held.number)
        if held.number and (held.run, held.number) != (self.newest.run, self.newest.number):
            raise Refused(Refusal.SUPERSEDED, "superseded")


class Line:
    """A transport of one edge to that twin."""

    def __init__(self, twin: Twin) -> None:
        self.twin, self.claim, self.sent = twin, Held(), 0

    def ask(self, claim: EdgeClaim) -> Standing | None:
        return self.twin.ask(claim)

    def deliver(self, _parcel: Parcel) -> None:
        self.twin.admit(self.claim)
        self.sent += 1

    def listen(self, _after: int) -> list[bytes]:
        self.twin.admit(self.claim)
        return []

    def close(self) -> None:
        pass


PARCEL = Parcel("axis", b"body")


def edge(twin: Twin, run: str, number: int = 0) -> tuple[ExclusiveTransport, list[Held]]:
    stored: list[Held] = []
    return ExclusiveTransport(Line(twin), "axis", Held(run, number), stored.append, "1.2"), stored


def test_an_edge_claims_before_its_first_message_and_once() -> None:
    twin = Twin()
    one, stored = edge(twin, "b1-aa")
    for _ in range(3):
        one.deliver(PARCEL)
        one.listen(0)
    assert stored == [Held("b1-aa", 1)]
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
    assert stored == [Held("b2-cc", 2)]


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
    twin.newest = Standing("axis", "b1-aa", 1)
    one.deliver(PARCEL)
    assert twin.newest == Standing("axis", "b3-cc", 3)


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
    assert stored == [Held("b1-aa", 1)]


@pytest.mark.parametrize("text", ["", "7", "x b1", "-1 b1", "1 ", "99999999999999999999 b1"])
def test_a_text_that_is_no_claim_is_none(text: str) -> None:
    assert held_of(text) is None
    assert held_of(Held("b1-aa", 7).text) == Held("b1-aa", 7)
