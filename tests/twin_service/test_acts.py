"""HTTP API of engineers' acts: who may do them, what is stored, and what an edge cannot send."""

import asyncio

import pytest
from service_system import ENGINEER, MSGPACK, OPERATOR, TOKEN, bearer, hello, place, served, twin_file, window

from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.messages import encode
from servotwin.messages.acts import Act, ActKind, encode_act
from servotwin.store.store import WORK_KINDS
from servotwin.twin.work import work
from servotwin.twin_service.auth import Verifiers, read_tokens
from servotwin.twin_service.twin_file import read_twin
from servotwin.up import enrolment

ACTS = "/v1/servos/ax-1/acts"
HOLD = {"act": "hold", "why": "the bearing is replaced"}


def with_service(folder, body, tokens=True):
    path = twin_file(folder, tokens=tokens)

    async def run():
        async with served(path) as (system, client):
            await body(system, client, read_twin(path).fleet)

    asyncio.run(run())


def worked(system, fleet):
    """Work on what waits, as a worker does; the kinds of messages that waited."""
    kinds = []
    for lease in system.store.lease("me", 10, 60.0, system.clocks.wall(), WORK_KINDS):
        kinds += [message.kind.value for message in lease.messages]
        assert system.store.commit([work(fleet, lease, system.clocks.wall())], system.clocks.wall()) == [True]
    return kinds


async def say_hello(client):
    answer = await client.post("/v1/servos/ax-1/letters", content=hello(), headers=MSGPACK | bearer())
    assert answer.status_code < 300


def test_an_engineer_holds_a_machine_and_the_act_is_kept(tmp_path):
    async def body(system, client, fleet):
        await say_hello(client)
        engineer = bearer(ENGINEER)
        assert (await client.post(ACTS, json=HOLD, headers=engineer)).status_code == 202
        assert set(await asyncio.to_thread(worked, system, fleet)) == {"letter", "act"}
        sent = window(0)
        await client.put(place(sent), content=encode(sent), headers=MSGPACK | bearer())
        await asyncio.to_thread(worked, system, fleet)
        found = (await client.get(ACTS, headers=engineer)).json()
        assert found["may_act"]
        assert {key: found["held"][key] for key in ("act", "who", "why")} == HOLD | {"who": "eva"}
        (trace,) = (await client.get("/v1/servos/ax-1/audit", headers=engineer)).json()
        assert "held by eva: the bearing is replaced" in [each["status"] for each in trace["evidence"]]
        assert system.store.outgoing("ax-1", 0) == []
        again = {"act": "roll back", "why": "it hums", "version": 99}
        assert (await client.post(ACTS, json=again, headers=engineer)).status_code == 202
        assert (await client.post(ACTS, json={"act": "release", "why": "done"}, headers=engineer)).status_code == 202
        await asyncio.to_thread(worked, system, fleet)
        found = (await client.get(ACTS, headers=bearer(OPERATOR))).json()
        assert (found["held"], found["may_act"]) == (None, False)
        assert ["version 99" in act["refused"] for act in found["acts"]] == [False, True, False]
        events = (await client.get("/v1/servos/ax-1/events", headers=engineer)).json()
        assert [one["kind"] for one in events] == ["act", "act", "act", "hello"]

    with_service(tmp_path, body)


def test_only_an_engineer_s_own_page_may_act(tmp_path):
    async def body(system, client, _fleet):
        await say_hello(client)
        for headers, status in (
            ({}, 401),
            (bearer("guess"), 401),
            (bearer(TOKEN), 403),
            (bearer(OPERATOR), 403),
            (bearer(ENGINEER) | {"origin": "http://evil.example"}, 403),
            (bearer(ENGINEER) | {"sec-fetch-site": "cross-site"}, 403),
        ):
            assert (await client.post(ACTS, json=HOLD, headers=headers)).status_code == status
        await client.post("/v1/session", json={"token": OPERATOR})
        assert (await client.post(ACTS, json=HOLD)).status_code == 403
        await client.post("/v1/session", json={"token": ENGINEER})
        assert (await client.post(ACTS, json=HOLD)).status_code == 202
        system.access.replace(Verifiers({}, {"eva": verifier_of(ENGINEER)}))  # an operator from now on
        assert (await client.post(ACTS, json=HOLD)).status_code == 403

    with_service(tmp_path, body)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"act": "hold"}, "why"),
        ({"act": "hold", "why": "  "}, "reason"),
        ({"act": "explode", "why": "x"}, "explode"),
        ({"act": "hold", "why": "x", "who": "boss"}, "who"),
        ({"act": "approve", "why": "x"}, "window"),
        ({"act": "approve", "why": "x", "window": ["b", -1]}, "window"),
        ({"act": "hold", "why": "x" * 5000}, "larger"),
    ],
)
def test_an_act_that_makes_no_sense_is_refused_in_a_sentence(tmp_path, asked, said):
    async def body(_system, client, _fleet):
        await say_hello(client)
        answer = await client.post(ACTS, json=asked, headers=bearer(ENGINEER))
        assert answer.status_code in (400, 413)
        assert said in answer.json()["detail"]

    with_service(tmp_path, body)


def test_a_machine_that_is_not_known_is_not_acted_on(tmp_path):
    async def body(_system, client, _fleet):
        assert (await client.post(ACTS, json=HOLD, headers=bearer(ENGINEER))).status_code == 404

    with_service(tmp_path, body)


def test_an_edge_cannot_send_an_act(tmp_path):
    async def body(system, client, _fleet):
        forged = encode_act(Act("ax-1", ActKind.RELEASE, "eva", "nothing", 1.0))
        answer = await client.post("/v1/servos/ax-1/letters", content=forged, headers=MSGPACK | bearer())
        assert (answer.status_code, answer.json()["code"]) == (400, "unknown_schema")
        assert system.store.servos() == []

    with_service(tmp_path, body)


def test_without_tokens_nobody_acts(tmp_path):
    async def body(_system, client, _fleet):
        await say_hello(client)
        answer = await client.post(ACTS, json=HOLD, headers={"host": "localhost"})
        assert answer.status_code == 403
        assert "no tokens" in answer.json()["detail"]

    with_service(tmp_path, body, tokens=False)


def test_a_name_has_one_role_and_its_token_is_revoked_with_it(tmp_path):
    path = twin_file(tmp_path)
    enrolment.enroll_operator(path, "ada", tmp_path / "ada.token", engineer=True)
    tokens = read_tokens(tmp_path / "tokens.toml")
    assert tokens.engineers["ada"] == verifier_of((tmp_path / "ada.token").read_text().strip())
    with pytest.raises(InvalidInput, match="other role"):
        enrolment.enroll_operator(path, "ada", tmp_path / "again.token")
    for name in ("ada", "eva"):
        enrolment.revoke(path, name)
    assert read_tokens(tmp_path / "tokens.toml").engineers == {}
    text = (tmp_path / "tokens.toml").read_text()
    (tmp_path / "tokens.toml").write_text(text + '[engineers]\n"me" = "' + "0" * 64 + '"\n')
    with pytest.raises(InvalidInput, match="'me' is an operator and an engineer"):
        read_tokens(tmp_path / "tokens.toml")
