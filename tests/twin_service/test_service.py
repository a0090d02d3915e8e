"""The twin's HTTP API: accepted requests, refused requests, and no acknowledgement without a commit."""

import asyncio
import re

import msgspec
import pytest
from service_requests import code, put
from service_system import OPERATOR, OTHER, TOKEN, bearer, hello, place, unpacked, window

from servotwin.link.body_mark import body_mark
from servotwin.link.seal import TO_EDGE, key_of, opened, verifier_of
from servotwin.messages import Acknowledge, Setting, Update, decode, encode
from servotwin.messages.codec import compress
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import WorkResult
from servotwin.twin_service.auth import read_tokens, write_tokens


def test_a_window_is_committed_then_acknowledged_and_known_the_second_time(serving):
    async def body(system, client):
        sent = window(3)
        first, second = await put(client, sent), await put(client, sent)
        assert (first.status_code, second.status_code) == (201, 200)
        for answer in (first, second):
            [acknowledged] = unpacked(answer.content)
            assert decode(acknowledged) == Acknowledge("ax-1", "b", 3)
        assert system.store.window("ax-1", "b", 3).body == encode(sent)
        kept = await client.get(place(sent), headers=bearer(OPERATOR))
        assert decode(kept.content) == sent

    serving(body)


@pytest.mark.parametrize("encoding", ["deflate", "zstd", "identity"])
def test_a_compressed_window_is_the_same_window(serving, encoding):
    async def body(_system, client):
        sent = window(3)
        packed = compress(encode(sent), "" if encoding == "identity" else encoding)
        assert (await put(client, packed, to=place(sent), content_encoding=encoding)).status_code == 201
        assert (await put(client, sent)).status_code == 200

    serving(body)


def test_another_window_of_the_same_identity_is_a_conflict(serving):
    async def body(system, client):
        assert (await put(client, window(3))).status_code == 201
        assert code(await put(client, window(3, samples=100))) == (409, "conflict")
        assert system.store.window("ax-1", "b", 3).body == encode(window(3))

    serving(body)


def test_windows_may_come_in_any_order(serving):
    async def body(system, client):
        assert (
            await client.post("/v1/servos/ax-1/letters", content=hello(time=100.0), headers=bearer())
        ).status_code == 202
        for sequence in (7, 2, 9, 0):
            assert (await put(client, window(sequence))).status_code == 201
        assert system.store.servo("ax-1").windows == 4

    serving(body)


def test_an_edge_with_a_backlog_is_told_the_pause_before_older_windows(serving):
    async def body(system, client):
        sent = await client.post("/v1/servos/ax-1/letters", content=hello(time=100.0), headers=bearer())
        assert sent.status_code == 202
        assert "servotwin-older-pause" not in (await put(client, window(9), **{"servotwin-waiting": "30"})).headers
        for n in range(200):  # others of a fleet, and workers that need 50 ms for each
            system._pace.pause(f"ax-{n}", 30)
        system._pace._rate = 10.0
        told = [await put(client, window(k), **{"servotwin-waiting": text}) for k, text in enumerate(("30", "x", "0"))]
        assert [answer.headers.get("servotwin-older-pause") for answer in told] == ["20", None, None]
        assert [answer.status_code for answer in told] == [201] * 3
        # New messages of others come before those that were overtaken.
        lag = system.store.turn_lag(system.clocks.wall() + 30.0)
        assert lag == pytest.approx(30.0, abs=5.0)
        (lease,) = system.store.lease("me", 1, 60.0, system.clocks.wall())
        assert [message.key for message in lease.messages if message.kind == "window"] == ["b/9", "b/0", "b/1", "b/2"]

    serving(body)


@pytest.mark.slow
def test_tokens_decide_who_may_read_and_write(serving):
    async def body(_system, client):
        path = place(window())
        assert code(await client.put(path, content=encode(window()))) == (401, "bad_token")
        assert code(await put(client, window(), "guess")) == (401, "bad_token")
        assert code(await put(client, window(), OTHER)) == (403, "bad_token")
        assert code(await put(client, window(), OPERATOR)) == (403, "bad_token")
        assert code(await put(client, window(), "x" * 5000)) == (401, "bad_token")
        for reading in ("/v1/servos", "/v1/servos/ax-1", "/v1/servos/ax-1/audit", "/v1/servos/ax-1/events", path):
            assert code(await client.get(reading)) == (401, "bad_token")
            assert code(await client.get(reading, headers=bearer(TOKEN))) == (403, "bad_token")
        assert code(await client.get("/v1/servos/ax-1/outgoing", headers=bearer(OTHER))) == (403, "bad_token")
        assert (await client.get("/v1/servos", headers=bearer(OPERATOR))).json() == []

    serving(body)


def test_a_message_of_an_unknown_servo_may_be_sent_again(serving):
    async def body(_system, client):
        stranger = window(servo="stranger")
        assert code(await put(client, stranger, "any")) == (404, "unknown_servo")

    serving(body, tokens=False)


def test_a_message_must_be_what_its_address_says(serving):
    async def body(_system, client):
        assert code(await put(client, encode(window(servo="ax-2")), to=place(window()))) == (400, "other_name")
        assert code(await put(client, encode(window(4)), to=place(window(5)))) == (400, "other_name")
        assert code(await put(client, encode(window(boot="c")), to=place(window()))) == (400, "other_name")
        letters = "/v1/servos/ax-1/letters"
        assert code(await client.post(letters, content=encode(window()), headers=bearer())) == (400, "not_understood")
        assert code(await put(client, hello(), to=place(window()))) == (400, "not_understood")
        acknowledge = encode(Acknowledge("ax-1", "b", 1))
        assert code(await client.post(letters, content=acknowledge, headers=bearer())) == (400, "not_understood")

    serving(body)


def test_an_answer_tells_which_body_came(serving):
    """As a proxy may have changed it: only the edge knows what it sent."""

    async def body(system, client):
        letters, cut = "/v1/servos/ax-1/letters", encode(window())[:-5]
        stored = await client.post(letters, content=hello(), headers=bearer())
        assert (stored.status_code, unpacked(stored.content)) == (202, [body_mark(hello(), "").encode()])
        refused = await put(client, cut, to=place(window()), content_encoding="deflate")
        assert refused.json()["mark"] == body_mark(cut, "deflate")
        other = await put(client, encode(window(4)), to=place(window(5)))
        assert "mark" not in other.json()  # a changed address is no reason to drop the body that came
        assert "mark" not in (await client.post(letters, content=hello())).json()

    serving(body)


def test_invalid_messages_are_refused_with_distinct_codes(serving):
    async def body(system, client):
        path, whole = place(window()), encode(window())
        middle = len(whole) // 3
        flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
        assert code(await put(client, whole[:-5], to=path)) == (400, "not_understood")
        assert code(await put(client, b"", to=path)) == (400, "not_understood")
        assert code(await put(client, flipped, to=path)) == (400, "bad_checksum")
        newer = msgspec.msgpack.encode({"type": "window/2", "servo": "ax-1"})
        assert code(await put(client, newer, to=path)) == (400, "unknown_schema")
        assert code(await put(client, whole, to=path, content_encoding="br")) == (400, "not_understood")
        assert code(await put(client, whole, to=path, content_encoding="deflate")) == (400, "not_understood")
        counted = (await client.get("/metrics")).text
        assert 'servotwin_refused_total{code="not_understood"} 4' in counted
        assert 'servotwin_refused_total{code="bad_checksum"} 1' in counted
        assert 'servotwin_refused_total{code="unknown_schema"} 1' in counted
        assert system.store.servo("ax-1") is None

    serving(body)


def test_messages_for_an_edge_are_sealed_and_read_again_without_harm(serving):
    update = Update("ax-1", 1, 0, ("b", 0), 0.0, 0.1, 0.01, (0.0, None), "ok", Setting(1e-4), 100.0)

    async def body(system, client):
        await client.post("/v1/servos/ax-1/letters", content=hello(), headers=bearer())
        request = client.get("/v1/servos/ax-1/outgoing?after=0&wait=20", headers=bearer())
        waiting = asyncio.create_task(request)
        await asyncio.sleep(0.1)
        assert not waiting.done()
        [claim] = system.store.lease("me", 1, 10.0, system.clocks.wall())
        done = tuple(message.id for message in claim.messages)
        made = WorkResult("ax-1", claim.serial, b"state", None, done, outgoing=(encode(update),))
        assert await system.dispatcher._committed(made)
        again = await client.get("/v1/servos/ax-1/outgoing", headers=bearer())
        for answer in (await waiting, again):
            [sealed] = unpacked(answer.content)
            message = opened(key_of(verifier_of(TOKEN)), TO_EDGE, "ax-1", sealed, 10_000)
            assert (message.serial, decode(message.body)) == (1, update)
        nothing = await client.get("/v1/servos/ax-1/outgoing?after=1&wait=0.05", headers=bearer())
        assert unpacked(nothing.content) == []

    serving(body)


@pytest.mark.parametrize(
    "query", ["after=x", "after=-1", "after=" + "9" * 5000, "wait=31", "wait=nan", "wait=-1", "wait=inf", "after=%00"]
)
def test_invalid_query_arguments_are_refused(serving, query):
    async def body(_system, client):
        answer = await client.get("/v1/servos/ax-1/outgoing?" + query, headers=bearer())
        assert code(answer) == (400, "not_understood")

    serving(body)


def test_an_unknown_path_or_method_has_an_error_body_of_the_same_form(serving):
    async def body(_system, client):
        assert code(await client.get("/nowhere")) == (404, "not_understood")
        assert code(await client.delete("/v1/servos")) == (405, "not_understood")
        huge = f"/v1/servos/ax-1/windows/b/{'9' * 6000}"
        assert code(await client.get(huge, headers=bearer(OPERATOR))) == (400, "not_understood")

    serving(body)


def test_a_token_is_valid_exactly_while_it_is_in_the_file(serving):
    async def body(system, client):
        path = serving.folder / "tokens.toml"
        known = read_tokens(path)
        assert (await put(client, window())).status_code == 201
        fresh = {**known.servos, "ax-1": verifier_of("another")}
        write_tokens(path, known.__class__(fresh, known.operators))
        assert system.tokens.refresh()
        assert code(await put(client, window())) == (401, "bad_token")
        assert (await put(client, window(), "another")).status_code == 200
        path.write_text("[servos]\n'ax 1' = 3\n")
        assert not system.tokens.refresh()
        assert (await put(client, window(), "another")).status_code == 200

    serving(body)


def test_no_response_and_no_log_line_contains_a_token(serving, caplog):
    caplog.set_level("DEBUG")
    output = []

    async def body(system, client):
        for token in (TOKEN, OTHER, OPERATOR, "guess-of-a-token"):
            answers = await put(client, window(), token), await client.get("/v1/servos", headers=bearer(token))
            output.extend(answer.text + str(dict(answer.headers)) for answer in answers)
        output.append((await client.get("/metrics")).text)
        output.append(repr(system.config) + repr(read_tokens(system.config.tokens)))

    serving(body)
    everything = " ".join(output) + "".join(str(vars(record)) for record in caplog.records)
    for token in (TOKEN, OTHER, OPERATOR, "guess-of-a-token"):
        assert token not in everything
        assert verifier_of(token).hex() not in everything


def test_health_names_the_unhealthy_part(serving):
    async def body(system, client):
        answer = await client.get("/healthz")
        assert answer.status_code == 503
        content = answer.json()
        assert content["store"] is True
        assert content["workers"] == 0
        assert content["waiting"]["messages"] == 0
        system.executor.fault = "gone"
        assert (await client.get("/healthz")).status_code == 503

    serving(body)


@pytest.mark.slow
def test_health_names_the_lag(serving):
    async def body(system, client):
        assert (await client.get("/healthz")).json()["degraded"] == []
        assert (await put(client, window())).status_code == 201
        await asyncio.sleep(0.6)  # a backlog that was read is served again for so long
        health = (await client.get("/healthz")).json()
        assert health["waiting"]["lag"] >= 0.6
        (sentence,) = health["degraded"]
        assert re.fullmatch(r"new messages of a servo have waited for \d+ s, 1 in all", sentence)
        assert "\nservotwin_lag_seconds " in (await client.get("/metrics")).text

    serving(body, "lag_limit_s = 0.5")


def test_a_store_that_rejects_writes_is_unhealthy_although_it_can_be_read(serving):
    async def body(system, client):
        write, system.store.write = system.store.write, full
        assert code(await put(client, window(0))) == (503, "unavailable")
        assert (await client.get("/healthz")).json()["store"] is False
        assert "servotwin_store_ok 0\n" in (await client.get("/metrics")).text
        system.store.write = write
        assert (await put(client, window(0))).status_code == 201
        assert (await client.get("/healthz")).json()["store"] is True

    def full(*_args):
        raise StoreUnavailable("store: not available now (database or disk is full)")

    serving(body)
