"""Proxies between edge and twin: only the twin's answer to the very body that was sent counts."""

import time
from collections.abc import Callable
from contextlib import closing, suppress

import msgspec
import pytest
from faketwin import FakeTwin, Handler
from http_parcels import LETTER, parcel

from servotwin.link.body_mark import body_mark
from servotwin.link.claim import ExclusiveTransport, HeldClaim
from servotwin.link.http import HttpTransport
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import (
    ClaimStatus,
    EdgeClaim,
    Refusal,
)

PARCEL = parcel(0)
CHANGED = "a proxy on the way changes it, or swaps answers"


@pytest.mark.parametrize("status", [404, 405])
@pytest.mark.parametrize("message", [PARCEL, LETTER])
@pytest.mark.parametrize("asked", [True, False])
def test_an_address_that_the_twin_does_not_know_refuses_no_message(
    twin: FakeTwin, link: HttpTransport, message: Parcel, status: int, asked: bool
) -> None:
    """As where a proxy strips a part of the path: the twin's own answer, of which no edge may be sure before."""
    twin.claim_status = ClaimStatus("axis-1", protocol=5)
    if asked:
        link.ask(EdgeClaim("axis-1", "b0"))
    twin.fault = lambda handler, _body: (
        handler.answer(status, b'{"code":"not_understood","detail":"there is no such path"}') or True
    )
    with pytest.raises(Unreachable, match="there is no such path"):
        link.deliver(message)
    with pytest.raises(Unreachable, match="there is no such path"):
        link.listen(0)


def test_a_proxy_that_loses_the_path_for_a_while_costs_neither_window_nor_claim(twin: FakeTwin) -> None:
    twin.claim_status = ClaimStatus("axis-1", protocol=5)
    link = ExclusiveTransport(HttpTransport(twin.url, "axis-1", "secret", wait_s=0.1), "axis-1", HeldClaim("b0"))
    with closing(link):
        twin.fault = lambda handler, _body: (
            handler.answer(404, b'{"code":"not_understood","detail":"there is no such path"}') or True
        )
        with pytest.raises(Unreachable):
            link.deliver(PARCEL)
        twin.fault, twin.claim_status = None, ClaimStatus("axis-1", "b0", 1, protocol=5)
        link.deliver(PARCEL)
        assert link.claim == HeldClaim("b0", 1)
        assert list(twin.windows) == [("b0", 0)]


def marking(mark: str | None) -> Callable[[Handler, bytes], bool]:
    """A fault: refuse each message for good, and tell that a body with `mark` came; None: the one that was sent."""

    def refuse(handler: Handler, body: bytes) -> bool:
        if handler.path.endswith("/claim"):
            return False
        told = body_mark(body, handler.headers.get("Content-Encoding", "")) if mark is None else mark
        answer = {"code": Refusal.NOT_UNDERSTOOD.value, "detail": "As told.", "mark": told}
        handler.answer(422, msgspec.json.encode(answer))
        return True

    return refuse


@pytest.mark.parametrize("message", [PARCEL, LETTER])
def test_only_a_refusal_of_the_body_as_it_was_sent_is_one(twin: FakeTwin, link: HttpTransport, message: Parcel) -> None:
    twin.claim_status = ClaimStatus("axis-1", protocol=5)
    link.ask(EdgeClaim("axis-1", "b0"))
    for mark in ("", "00000000 deflate", "00000000 "):
        twin.fault = marking(mark)
        with pytest.raises(Unreachable, match=CHANGED):
            link.deliver(message)
    twin.fault = marking(None)
    with pytest.raises(Refused, match="As told"):
        link.deliver(message)


@pytest.mark.parametrize(
    ("status", "body"), [(200, b"login"), (202, b""), (202, msgspec.msgpack.encode([b"00000000 "])), (204, b"")]
)
def test_only_the_twin_s_answer_to_a_letter_delivers_it(
    twin: FakeTwin, link: HttpTransport, status: int, body: bytes
) -> None:
    """As a proxy's own page, and the answer to an earlier letter, which a proxy has sent twice."""
    twin.claim_status = ClaimStatus("axis-1", protocol=5)
    link.ask(EdgeClaim("axis-1", "b0"))

    def answer(handler: Handler, _body: bytes) -> bool:
        handler.answer(status, body)
        return True

    twin.fault = answer
    with pytest.raises(Unreachable):
        link.deliver(LETTER)


def test_after_an_answer_that_came_twice_the_next_ones_belong_to_their_requests_again(
    twin: FakeTwin, link: HttpTransport
) -> None:
    """On one connection each answer would else be taken for that to the request after its own."""
    twin.claim_status = ClaimStatus("axis-1", protocol=5)
    link.ask(EdgeClaim("axis-1", "b0"))

    def twice(handler: Handler, _body: bytes) -> bool:
        if twin.requests["POST"] == 2:
            handler.answer(202, msgspec.msgpack.encode([b"00000000 "]))
            handler.wfile.flush()
            time.sleep(0.1)
            handler.answer(202, msgspec.msgpack.encode([b"00000000 "]))
        return twin.requests["POST"] == 2

    twin.fault = twice
    for _ in range(2):
        with suppress(Unreachable):
            link.deliver(LETTER)
    link.deliver(PARCEL)
    assert link.ask(EdgeClaim("axis-1", "b0")) == twin.claim_status
    assert twin.windows.keys() == {("b0", 0)}


def test_a_twin_of_a_version_before_tells_no_body(twin: FakeTwin, link: HttpTransport) -> None:
    twin.claim_status = ClaimStatus("axis-1", protocol=4)
    link.ask(EdgeClaim("axis-1", "b0"))
    link.deliver(LETTER)
    twin.fault = marking("")
    with pytest.raises(Refused):
        link.deliver(LETTER)
