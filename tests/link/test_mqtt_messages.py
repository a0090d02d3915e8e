"""Pace of a backlog over a broker, between versions with and without it."""

import msgspec
from msgspec import Struct

from servotwin.link import mqtt_messages as wire
from servotwin.link.seal import key_of, verifier_of

KEY = key_of(verifier_of("secret"))


class EarlierPut(Struct, frozen=True, omit_defaults=True, tag="carry/1"):
    body: bytes
    encoding: str = ""
    claim: str = ""


class EarlierAnswer(Struct, frozen=True, tag="taken/1"):
    pass


def test_what_waits_and_the_pause_arrive() -> None:
    sent = wire.PutRequest(b"window", waiting=30)
    assert wire.decode_request(KEY, "ax-1", wire.encode_request(KEY, "ax-1", 7, sent)).content == sent
    answer = wire.PutResponse(12.5)
    assert wire.decode_response(KEY, "ax-1", wire.encode_response(KEY, "ax-1", 7, answer)) == (7, answer)


def test_versions_without_a_pace_ignore_it_and_are_understood() -> None:
    told = msgspec.msgpack.encode(wire.PutRequest(b"window", waiting=30))
    assert msgspec.msgpack.decode(told, type=EarlierPut) == EarlierPut(b"window")
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(wire.PutResponse(12.5)), type=EarlierAnswer) == EarlierAnswer()
    earlier = msgspec.msgpack.encode(EarlierAnswer())
    assert msgspec.msgpack.decode(earlier, type=wire.PutResponse).older_pause == 0.0
    assert msgspec.msgpack.encode(wire.PutResponse()) == earlier
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(EarlierPut(b"w")), type=wire.PutRequest).waiting == 0
