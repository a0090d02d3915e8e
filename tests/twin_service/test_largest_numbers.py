"""No number that an edge reports makes the store hold what it takes for damage, which stops the twin for all servos."""

import asyncio
from pathlib import Path

import pytest
from leases import START, claim, fleet, windows
from msgspec.structs import replace
from service_system import MSGPACK, OTHER, bearer, place, served, twin_file, window

from servotwin.messages import (
    Answer,
    Cause,
    Fallback,
    Hello,
    InvalidMessage,
    Message,
    Reason,
    Receipt,
    RequestOutcome,
    Setting,
    decode,
    encode,
)
from servotwin.messages.checks import LARGEST_REPORTED
from servotwin.twin.work import work

LARGEST_STORED = 2**53
REPORTS: tuple[Message, ...] = (
    replace(window(), parameter_version=LARGEST_REPORTED),
    Hello("ax-1", "b", 0.0, 1000.0, LARGEST_REPORTED, Setting(0.0), "model"),
    Receipt("ax-1", 1, True, 1, Reason.APPLIED, LARGEST_REPORTED, "b"),
    Fallback("ax-1", "b", 1, Cause.SILENCE, 1.0, 0.5, 1, LARGEST_REPORTED, Setting(0.0)),
    Answer("ax-1", "b", 1, 1, RequestOutcome.ACCEPTED, LARGEST_REPORTED),
)


@pytest.mark.parametrize("number", [LARGEST_REPORTED + 1, LARGEST_STORED, 9999999999999999])
def test_a_claim_with_a_number_that_has_no_next_ones_is_refused_and_stops_nobody(tmp_path: Path, number: int) -> None:
    """One edge could make the twin read-only for all of them, with one request."""

    async def run() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            headers = {**bearer(), **MSGPACK, "servotwin-claim": f"{number} run"}
            mine, other = window(), window(servo="ax-2")
            refused = await client.put(place(mine), content=encode(mine), headers=headers)
            assert (refused.status_code, refused.json()["code"]) == (400, "not_understood")
            assert system.executor.damage is None
            stored = await client.put(place(other), content=encode(other), headers=bearer(OTHER))
            assert stored.status_code == 201

    asyncio.run(run())


@pytest.mark.parametrize("message", REPORTS)
def test_a_version_is_refused_from_which_the_twin_could_not_count_on(message: Message) -> None:
    field = "newest" if isinstance(message, Answer) else "parameter_version"
    assert decode(encode(message)) == message
    with pytest.raises(InvalidMessage, match=field):
        decode(encode(replace(message, **{field: LARGEST_REPORTED + 1})))


def test_versions_that_follow_the_largest_one_can_be_stored_and_sent() -> None:
    one = windows()[0]
    hello = Hello("axis", one.boot, 0.0, one.rate, LARGEST_REPORTED, START, one.model_version)
    result = work(fleet(), claim(encode(decode(encode(hello))), *windows()[:3]), 10.0)
    updates = [row.version for row in result.evidence if row.kind == "update"]
    assert updates == [LARGEST_REPORTED + n for n in (1, 2, 3)]
    assert max(row.version or 0 for row in result.evidence) <= LARGEST_STORED
    assert len([decode(sent) for sent in result.outgoing]) == 3
