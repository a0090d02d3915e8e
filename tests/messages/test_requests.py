"""Requests and answers as bytes: round trips and refusals."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.messages import (
    Answer,
    Ask,
    InvalidMessage,
    LongerWindow,
    Probe,
    Request,
    RequestOutcome,
    Resend,
    decode,
    encode,
)
from servotwin.messages.checks import LARGEST_REPORTED

SECONDS = st.floats(1e-3, 9.0)
ASKS = st.one_of(
    st.builds(lambda length, share: LongerWindow(length, share * length), SECONDS, st.floats(0.0, 0.999)),
    st.builds(Probe, st.floats(1e-9, 1.0) | st.floats(-1.0, -1e-9), SECONDS, st.integers(1, 16)),
    st.builds(
        lambda size, places: Probe(size, 1.0, places=(*places, 0.0)),
        st.floats(1e-9, 1.0),
        st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=15),
    ),
)
NAMES = st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")
COUNTS = st.integers(1, 2**53)
REQUEST = Request("axis-1", "b0", 1, LongerWindow(2.0, 0.3), 60.0, "two windows without the gap")


@given(NAMES, NAMES, COUNTS, ASKS, st.floats(allow_nan=False, allow_infinity=False), st.text(max_size=256))
def test_requests_survive_the_bytes(
    servo: str, boot: str, serial: int, ask: Ask, not_after: float, reason: str
) -> None:
    request = Request(servo, boot, serial, ask, not_after, reason)
    assert decode(encode(request)) == request
    assert len(encode(request)) < 1500


@given(NAMES, NAMES, COUNTS, COUNTS, st.sampled_from(RequestOutcome), st.integers(1, LARGEST_REPORTED))
def test_answers_survive_the_bytes(
    servo: str, boot: str, serial: int, sample: int, outcome: RequestOutcome, newest: int
) -> None:
    answer = Answer(servo, boot, serial, sample, outcome, newest)
    assert decode(encode(answer)) == answer


@given(NAMES, st.none() | NAMES, COUNTS, st.none() | COUNTS)
def test_requests_for_missing_windows_survive_the_bytes(
    servo: str, boot: str | None, first: int, more: int | None
) -> None:
    last = None if more is None else first + more
    resend = Resend(servo, boot, min(first, 2**52), last if last is None else min(last, 2**53), "restored")
    assert decode(encode(resend)) == resend


def test_a_request_for_missing_windows_names_a_range() -> None:
    some, rest, all_ = Resend("axis-1", "b0", 3, 5), Resend("axis-1", "b0", 7), Resend("axis-1")
    assert [n for n in range(9) if some.asks_for("b0", n)] == [3, 4, 5]
    assert [n for n in range(9) if rest.asks_for("b0", n)] == [7, 8]
    assert not some.asks_for("b1", 4)
    assert all_.asks_for("b1", 0)
    with pytest.raises(InvalidMessage, match="first 6 is after last 5"):
        decode(msgspec.msgpack.encode({"type": "resend/1", "servo": "axis-1", "first": 6, "last": 5}))


def test_the_two_kinds_are_distinguished() -> None:
    window, probe = (msgspec.structs.replace(REQUEST, ask=ask) for ask in (LongerWindow(2.0, 0.3), Probe(1e-4, 0.85)))
    assert isinstance(decode(encode(window)).ask, LongerWindow)  # type: ignore[union-attr]
    assert isinstance(decode(encode(probe)).ask, Probe)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"servo": "a b"}, "servo"),
        ({"serial": 0}, "serial"),
        ({"not_after": math.inf}, "not_after"),
        ({"reason": "x" * 257}, "reason"),
        ({"ask": {"type": "shake"}}, "shake"),
        ({"ask": {"type": "window", "window_s": 0.0, "pre_trigger_s": 0.0}}, "window_s"),
        ({"ask": {"type": "window", "window_s": 601.0, "pre_trigger_s": 0.0}}, "window_s"),
        ({"ask": {"type": "window", "window_s": math.nan, "pre_trigger_s": 0.0}}, "window_s"),
        ({"ask": {"type": "window", "window_s": 1.0, "pre_trigger_s": 1.0}}, "pre_trigger_s"),
        ({"ask": {"type": "window", "window_s": 1.0, "pre_trigger_s": -0.1}}, "pre_trigger_s"),
        ({"ask": {"type": "probe", "size": 0.0, "hold_s": 1.0}}, "size"),
        ({"ask": {"type": "probe", "size": math.inf, "hold_s": 1.0}}, "size"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 0.0}}, "hold_s"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 100.0, "strokes": 4}}, "takes 800.0 s"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 1.0, "strokes": 17}}, "strokes"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 1.0, "places": [1.0, 0.5]}}, "places end at 0.5"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 1.0, "places": [1.1, 0.0]}}, "places"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 101.0, "places": [1.0, 0.2] * 2 + [1.0, 0.0]}}, "takes"),
        ({"ask": {"type": "probe", "size": 1e-4, "hold_s": 1.0, "strokes": 0}}, "strokes"),
    ],
)
def test_an_invalid_field_is_named(change: dict[str, Any], words: str) -> None:
    raw = msgspec.to_builtins(REQUEST) | change
    with pytest.raises(InvalidMessage, match=words):
        decode(msgspec.msgpack.encode(raw))


@given(st.binary(max_size=200))
def test_cut_and_random_bytes_are_refused(noise: bytes) -> None:
    whole = encode(REQUEST)
    for data in (noise, whole[: len(noise) % len(whole)], whole + noise[:1] if noise else b""):
        with pytest.raises(InvalidMessage):
            decode(data)


def test_a_move_there_and_back_has_the_bytes_of_earlier_versions_and_other_places_are_additional() -> None:
    plain, several = (
        msgspec.msgpack.decode(encode(msgspec.structs.replace(REQUEST, ask=ask)))["ask"]
        for ask in (Probe(1e-4, 0.85), Probe(1e-4, 0.85, places=(0.4, 0.0, 1.0, 0.0)))
    )
    assert plain == {"type": "probe", "size": 1e-4, "hold_s": 0.85}
    assert several == plain | {"places": [0.4, 0.0, 1.0, 0.0]}


def test_which_outcomes_are_temporary() -> None:
    assert {outcome for outcome in RequestOutcome if outcome.temporary} == {
        RequestOutcome.BUSY,
        RequestOutcome.TOO_SOON,
    }
