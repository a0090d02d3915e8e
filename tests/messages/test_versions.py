"""Versions speak to each other: an update names what it needs, and no edge applies a part of one that it half knows."""

import msgspec
import pytest

from servotwin.edge.guard import Instant, Limits, judge
from servotwin.edge.parameters import Parameters
from servotwin.messages import (
    KNOWN_FIELDS,
    CascadeGains,
    Gains,
    Hello,
    InvalidMessage,
    Reason,
    Receipt,
    Refusal,
    Setting,
    Update,
    decode,
    encode,
    needed_fields,
)

GAINS = Gains(200.0, 0.0, -10.0, 0.1)
HERE = Instant("axis", "b1", 100, 10.0)


def update(gains: Gains | None = GAINS, **changes: object) -> Update:
    setting = Setting(1e-5, gains)
    made = Update("axis", 1, 0, ("b1", 0), 1.0, 0.1, 0.01, (0.08, 0.12), "ok", setting, 20.0)
    return msgspec.structs.replace(made, **{"needs": needed_fields(setting), **changes})


NOTCH = msgspec.structs.replace(GAINS, notch_hz=80.0, friction_feedforward=0.1)


def test_an_update_names_the_fields_that_not_every_edge_knows() -> None:
    assert update().needs == update(None).needs == ()
    assert update(NOTCH).needs == ("friction_feedforward", "notch_hz")
    # Edges had these before they read `needs`, and most updates set them.
    known = msgspec.structs.replace(GAINS, integral_only=True, velocity_feedforward=0.5, velocity_time=0.2)
    assert update(known).needs == ()


@pytest.mark.parametrize(("sent", "tag"), [(update(), "update/2"), (update(NOTCH), "update/3")])
def test_an_edge_that_reads_no_needs_does_not_know_an_update_that_has_some(sent: Update, tag: str) -> None:
    assert msgspec.msgpack.decode(encode(sent))["type"] == tag
    assert decode(encode(sent)) == sent
    assert type(decode(encode(sent))) is Update


def test_an_edge_refuses_an_update_that_needs_what_it_does_not_know() -> None:
    limits = Limits(notch_max_hz=200.0)
    known = judge(update(NOTCH), Parameters(), limits, HERE, GAINS)
    assert known is Reason.APPLIED
    later = update(NOTCH, needs=("notch_hz", "second_notch_hz"))
    # As it arrives from a newer twin: with a field of the gains that this version drops when it reads it.
    document = msgspec.msgpack.decode(encode(later))
    document["setting"]["gains"]["second_notch_hz"] = 120.0
    read = decode(msgspec.msgpack.encode(document))
    assert isinstance(read, Update)
    assert judge(read, Parameters(), limits, HERE, GAINS) is Reason.NOT_KNOWN
    assert set(KNOWN_FIELDS) >= set(update(NOTCH).needs)


def test_a_hello_without_a_protocol_is_of_version_1_and_one_with_more_fields_is_read() -> None:
    hello = Hello("axis", "b1", 0.0, 10.0, 0, Setting(0.0), "model", 2)
    document = msgspec.msgpack.decode(encode(hello))
    assert document.pop("protocol") == 2
    read = decode(msgspec.msgpack.encode({**document, "colour": "red"}))
    assert isinstance(read, Hello)
    assert read.protocol == 1
    with pytest.raises(InvalidMessage) as error:
        decode(msgspec.msgpack.encode({"type": "hello/9"}))
    assert error.value.refusal is Refusal.UNKNOWN_SCHEMA


def test_gains_of_another_law_are_needed_as_a_whole() -> None:
    cascade = Setting.of(1e-5, CascadeGains(20.0, 0.5))
    assert needed_fields(cascade) == ("law",)
    assert "law" in KNOWN_FIELDS


def test_a_receipt_says_more_only_where_there_is_more_to_say() -> None:
    """An older twin reads it without the detail, and an older edge's has none."""
    receipt = Receipt("axis", 3, False, 100, Reason.GAINS_OUT_OF_BOUNDS, 2, "b1")
    assert "detail" not in msgspec.msgpack.decode(encode(receipt))
    told = msgspec.structs.replace(receipt, detail="kp_v_per_m = 5: must be within 1 and 2")
    assert decode(encode(told)) == told
    document = msgspec.msgpack.decode(encode(told))
    del document["detail"]
    assert decode(msgspec.msgpack.encode(document)) == receipt
    # It is printed on terminals.
    with pytest.raises(InvalidMessage):
        decode(msgspec.msgpack.encode({**document, "detail": "\x1b[2J"}))
