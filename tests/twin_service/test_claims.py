"""Two edges of one servo at the service: the older is refused, and an alarm is raised only if it still runs."""

import asyncio
import logging
from pathlib import Path

import httpx
import pytest
from service_system import MSGPACK, OTHER, bearer, place, served, twin_file, window

from servotwin import __version__
from servotwin.link.claim import HeldClaim
from servotwin.messages import PROTOCOL, ClaimStatus, EdgeClaim, decode, encode
from servotwin.messages.claims import CLONED

PATH = "/v1/servos/ax-1/claim"


async def ask(client: httpx.AsyncClient, claim: EdgeClaim) -> ClaimStatus:
    response = await client.post(PATH, content=encode(claim), headers={**bearer(), **MSGPACK})
    assert response.status_code == 200, response.text
    status = decode(response.content)
    assert isinstance(status, ClaimStatus)
    return status


async def put(client: httpx.AsyncClient, sequence: int, boot: str, number: int, run: str | None = None) -> int:
    return (await put_answer(client, sequence, boot, number, run)).status_code


async def put_answer(
    client: httpx.AsyncClient, sequence: int, boot: str, number: int, run: str | None = None, samples: int = 200
) -> httpx.Response:
    headers = {**bearer(), **MSGPACK}
    if number:
        headers["servotwin-claim"] = HeldClaim(run or boot, number).text
    message = window(sequence, boot=boot, start=0.0, samples=samples)
    return await client.put(place(message), content=encode(message), headers=headers)


async def listen(client: httpx.AsyncClient, held: HeldClaim, wait: float) -> int:
    headers = {**bearer(), "servotwin-claim": held.text}
    return (await client.get(f"/v1/servos/ax-1/outgoing?after=0&wait={wait}", headers=headers)).status_code


def test_a_folder_that_was_put_back_is_an_alarm(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            await ask(client, EdgeClaim("ax-1", "one", 0, 1))
            await ask(client, EdgeClaim("ax-1", "two", 0, 2))
            for _ in range(2):  # once, although it is repeated
                assert (await ask(client, EdgeClaim("ax-1", "three", 0, 3, PROTOCOL, behind=True))).run == "three"
            [alarm] = system.store.events("ax-1")
            assert alarm.status.startswith("the edge's run three began in a folder that knows nothing of the run two")

    asyncio.run(run())
    assert [line.message for line in caplog.records if line.levelno >= logging.WARNING] == ["folder behind"]


def test_a_copied_folder_is_refused_and_an_alarm_is_stored(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            limits = system.config.samples_per_window, round(1e6 * system.config.megabytes_per_day)
            told = await ask(client, EdgeClaim("ax-1", "one"))
            assert told == ClaimStatus("ax-1", "", 0, PROTOCOL, __version__, *limits)
            assert (await ask(client, EdgeClaim("ax-1", "one", 0, 1))).run == "one"
            assert await put(client, 0, "one", 1) == 201
            poll = asyncio.create_task(listen(client, HeldClaim("one", 1), 20.0))
            while not system.polls.open:
                await asyncio.sleep(0.01)
            assert (await ask(client, EdgeClaim("ax-1", "two", 0, 2))).run == "two"
            assert await asyncio.wait_for(poll, 10.0) == 409, "its poll ends at once, without messages"
            assert await put(client, 1, "one", 1) == 409
            assert await put(client, 0, "two", 2) == 201
            assert system.store.events("ax-1") == [], "a restart is no conflict"
            for _ in range(2):
                assert (await ask(client, EdgeClaim("ax-1", "one", 1))).run == "two"
            [alarm] = system.store.events("ax-1")
            assert alarm.kind == "alarm"
            assert alarm.status == "conflict: two edges of this servo run, one and two; the newer one counts"
            assert system.metrics.rejected.values[("superseded",)] >= 2
            assert "edge began" in caplog.messages
            assert (await client.get("/v1/servos/ax-2", headers=bearer(OTHER))).status_code == 403

    with caplog.at_level(logging.INFO, "servotwin"):
        asyncio.run(run())
    assert [record.message for record in caplog.records].count("conflict") == 2


def test_of_two_copies_of_a_running_edge_neither_counts_until_one_is_started_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a virtual machine that was cloned while it ran: same run, same claim, same numbers, other windows."""

    async def run() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            await ask(client, EdgeClaim("ax-1", "one", 0, 1))
            for number in (0, 1, 2):
                assert await put(client, number, "one", 1) == 201
            assert [await put(client, 0, "one", 1) for _ in range(3)] == [200, 200, 200], "repeated, and no conflict"
            for _ in range(2):
                assert (await put_answer(client, 0, "one", 1, samples=99)).json()["code"] == "conflict"
            [alarm] = system.store.events("ax-1")
            assert "another window came under the name one/0" in alarm.status
            assert await put(client, 3, "one", 1) == 201, "one alone may be a program that repeats a name"
            refused = await put_answer(client, 1, "one", 1, samples=99)
            assert refused.json()["code"] == "superseded", "kept by its edge"
            assert await put(client, 4, "one", 1) == 409
            status = await ask(client, EdgeClaim("ax-1", "one", 1))
            assert (status.run, status.number) == (CLONED, 2)
            [told, _first] = system.store.events("ax-1")
            assert "neither counts until one of them is started again" in told.status
            assert (await ask(client, EdgeClaim("ax-1", "two", 0, 3))).run == "two"
            assert await put(client, 0, "two", 3) == 201

    asyncio.run(run())
    assert caplog.messages.count("window in conflict") == 3


def test_windows_of_an_earlier_run_in_conflict_stop_nobody(tmp_path: Path) -> None:
    async def run() -> None:
        async with served(twin_file(tmp_path)) as (system, client):
            await ask(client, EdgeClaim("ax-1", "two", 0, 1))
            for samples, code in ((200, 201), (99, 409)):
                for number in (0, 1, 2):
                    answer = await put_answer(client, number, "one", 1, "two", samples)
                    assert answer.status_code == code
            assert system.store.claim_of("ax-1").run == "two"
            assert len(system.store.events("ax-1")) == 1

    asyncio.run(run())


def test_a_claim_outlives_a_restart_of_the_twin_and_an_older_backup_of_its_store(tmp_path: Path) -> None:
    async def first() -> None:
        async with served(twin_file(tmp_path)) as (_, client):
            assert (await ask(client, EdgeClaim("ax-1", "one", 0, 1))).number == 1

    async def second() -> None:
        async with served(tmp_path / "twin.toml") as (system, client):
            assert (await ask(client, EdgeClaim("ax-1", "two"))).run == "one"
            assert await put(client, 0, "two", 3) == 201, "the store is older than the edge's claim"
            assert tuple(system.store.claim_of("ax-1")) == ("two", 3)
            assert await put(client, 0, "one", 1) == 409

    asyncio.run(first())
    asyncio.run(second())


def test_of_two_that_claim_at_once_one_wins_and_a_repeated_claim_changes_nothing(tmp_path: Path) -> None:
    async def run() -> None:
        async with served(twin_file(tmp_path)) as (_, client):
            claims = [EdgeClaim("ax-1", name, 0, 1) for name in ("one", "two")]
            answers = await asyncio.gather(*(ask(client, claim) for claim in claims))
            assert answers[0] == answers[1]
            winner = answers[0].run
            assert (await ask(client, EdgeClaim("ax-1", "three", 0, 2))).run == "three"
            for claim in claims:
                assert (await ask(client, claim)).run == "three", winner

    asyncio.run(run())


def test_requests_without_a_claim_pass_and_broken_claims_are_refused(tmp_path: Path) -> None:
    async def run() -> None:
        async with served(twin_file(tmp_path)) as (_, client):
            await ask(client, EdgeClaim("ax-1", "one", 0, 1))
            assert await put(client, 0, "old", 0) == 201
            headers = {**bearer(), **MSGPACK, "servotwin-claim": "rubbish"}
            message = window(1, boot="old")
            assert (await client.put(place(message), content=encode(message), headers=headers)).status_code == 400
            version = await client.get("/v1/version")
            assert version.json() == {"protocol": PROTOCOL, "servotwin": __version__}
            other = await client.post(PATH, content=encode(EdgeClaim("ax-2", "x")), headers={**bearer(), **MSGPACK})
            assert (other.status_code, other.json()["code"]) == (400, "other_name")
            wrong = await client.post(PATH, content=encode(message), headers={**bearer(), **MSGPACK})
            assert (wrong.status_code, wrong.json()["code"]) == (400, "not_understood")

    asyncio.run(run())
