"""Requests with wrong tokens raise one alarm, however many they are and whatever names they bear."""

import asyncio
from pathlib import Path

import pytest
from service_system import MSGPACK, OPERATOR, TOKEN, bearer, hello, served, twin_file

from servotwin.twin_service import http_edge, wrong_tokens
from servotwin.twin_service.wrong_tokens import WrongTokens

LETTERS = "/v1/servos/{}/letters"


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def counted(clock: Clock, pause: float = 3600.0) -> tuple[WrongTokens, list[str]]:
    """A count of the requests to a twin of five edges, and its alarms."""
    told: list[str] = []
    count = WrongTokens({f"ax-{number}" for number in range(1, 8)}.__contains__, pause, clock)
    return count, told


def test_an_edge_that_is_refused_again_and_again_is_named_and_a_mistyped_token_is_not() -> None:
    clock = Clock()
    count, told = counted(clock)
    for _ in range(4):
        count.note("ax-1")
    count.look(lambda _kind, sentence: told.append(sentence))
    assert not told
    assert not count.sentences()
    clock.now = 70.0
    count.note("ax-1")
    count.look(lambda _kind, sentence: told.append(sentence))
    assert told == [
        "5 requests within 2 min were refused because of a wrong token, 5 in the name of ax-1: copy the right token to "
        "that edge, or find out who sends them"
    ]
    [sentence] = count.sentences()
    assert "ax-1" not in sentence, "whoever asks for the health needs no token, and must not learn names"
    clock.now = 700.0
    assert not count.sentences()


def test_a_flood_of_wrong_tokens_under_any_names_is_one_alarm_in_a_pause_and_needs_no_memory() -> None:
    clock = Clock()
    count, told = counted(clock)
    for second in range(2 * 3600):
        clock.now = float(second)
        for name in (f"guess-{second}", f"ax-{second % 7 + 1}", "<script>", ""):
            count.note(name)
        count.look(lambda _kind, sentence: told.append(sentence))
    assert len(told) == 2
    assert told[1].startswith("14408 requests within 61 min were refused because of a wrong token, 515 in the name")
    assert told[1].count(" in the name of ") == 5
    assert "11834 in other names" in told[1]
    assert "guess" not in told[1]
    assert "<" not in told[1]
    assert len(count._servos) == 8


def test_the_pause_holds_when_a_stranger_begins_anew_and_is_never_short() -> None:
    clock = Clock()
    count, told = counted(clock, pause=0.0)
    for minute in range(121):
        clock.now = 60.0 * minute
        for _ in range(5 * (minute % 12 == 0)):  # begins anew each time: ten minutes without any end an episode
            count.note("ax-1")
        count.look(lambda _kind, sentence: told.append(sentence))
    assert len(told) == 11
    assert all(sentence.startswith("5 requests within 1 min") for sentence in told)


def test_the_twin_says_that_an_edge_has_a_wrong_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(http_edge, "REFUSED_POLL_S", 0.0)
    monkeypatch.setattr(wrong_tokens, "_LOOK_S", 0.01)
    posted: list[tuple[str, str, str]] = []

    async def body() -> list[str]:
        path = twin_file(tmp_path, '[service.webhook]\nurl = "http://127.0.0.1:9/hook"')
        async with served(path) as (system, client):
            assert system.webhook is not None
            monkeypatch.setattr(
                system.webhook, "_send", lambda _config, post: posted.append((post.servo, post.kind, post.sentence))
            )

            async def send(token: str | None) -> int:
                headers = {**MSGPACK, **(bearer(token) if token else {})}
                return (await client.post(LETTERS.format("ax-2"), content=hello("ax-2"), headers=headers)).status_code

            for _ in range(5):  # a page without a session, a scanner
                assert await send(None) == 401
                assert (await client.get("/v1/servos", headers=bearer(OPERATOR))).status_code == 200
            await asyncio.sleep(0.1)
            assert not posted
            assert [await send(token) for token in ("a secret", "a secret", TOKEN, "a secret")] == [401, 401, 403, 401]
            poll = await client.get("/v1/servos/ax-2/outgoing", headers=bearer("a secret"))
            assert poll.status_code == 401
            async with asyncio.timeout(30.0):
                while not posted:
                    await asyncio.sleep(0.01)
            return (await client.get("/healthz")).json()["degraded"]

    degraded = asyncio.run(body())
    [(servo, kind, sentence)] = posted
    assert (servo, kind) == ("twin", "wrong tokens")
    assert "5 in the name of ax-2" in sentence
    assert degraded == ["5 requests within 1 min were refused because of a wrong token; the log names the servos"]
    assert caplog.messages.count("wrong tokens") == 1
    assert "a secret" not in caplog.text + sentence + "".join(degraded)
