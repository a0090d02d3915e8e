"""Messages of the link: round trips, quantisation, and nothing but InvalidMessage for invalid bytes."""

import math
from array import array
from dataclasses import dataclass
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin import messages
from servotwin.messages import (
    Acknowledge,
    Band,
    Cause,
    Channel,
    Fallback,
    Gains,
    Hello,
    InvalidMessage,
    LearntResponse,
    Message,
    Reason,
    Receipt,
    Setting,
    Update,
    Verification,
    WindowMessage,
    checksum,
    codec,
    decode,
    encode,
    pack_channel,
    unpack_channel,
)
from servotwin.messages.legacy import MAX_LEGACY_BYTES

SAMPLES = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e200, max_value=1e200)


def window(**changes: Any) -> WindowMessage:
    channels = (pack_channel("position", "m", [0.0, 1e-3, 2e-3]), pack_channel("theta_m", "rad", [1.0, 1.0, 1.0]))
    values: dict[str, Any] = {
        "servo": "axis-1", "boot": "b0", "sequence": 4, "start": 20.0, "rate": 5000.0, "channels": channels,
        "reference_changes": ((20.0, 1e-3),), "parameter_version": 2, "model_version": "paper", "reason": "reference",
        "crc": checksum(channels),
    }  # fmt: skip
    return WindowMessage(**{**values, **changes})


UPDATE = Update("axis-1", 3, 2, ("b0", 4), 20.0, 0.1, 0.01, (0.08, None), "OK", Setting(1e-4), 60.0)
RECEIPT = Receipt("axis-1", 3, True, 110_000, Reason.APPLIED, 3, "b0")
HELLO = Hello("axis-1", "b0", 0.0, 5000.0, 0, Setting(0.0), "paper")
ACKNOWLEDGE = Acknowledge("axis-1", "b0", 4)
GAINS = Gains(1377.7, 0.0, -135.1, 0.1, 0.5, 1.5, -0.03)
VERIFICATION = Verification(256, 16, 1.0, 1e-6, 0.1, 1.9, 4.2, 1.2, False)
FULL_UPDATE = msgspec.structs.replace(
    UPDATE, setting=Setting(1e-4, GAINS, Band(5e-5, 2e-5, 0.1, 2.0)), verification=VERIFICATION
)
FALLBACK = Fallback("axis-1", "b0", 110_000, Cause.LIMIT_CYCLE, 2e-4, 5e-5, 3, 4, Setting(0.0, GAINS))
RESPONSE = LearntResponse("axis-1", 2, 5000.0, ((0.99, 0.02, 1e-6, -2e-6),), 0.0, 3e-4, 0.004, 0.1, 1e-4)
MESSAGES = [window(), UPDATE, FULL_UPDATE, RECEIPT, FALLBACK, HELLO, ACKNOWLEDGE, RESPONSE]


@pytest.mark.parametrize("message", MESSAGES)
def test_messages_survive_the_bytes(message: Message) -> None:
    assert decode(encode(message)) == message


def test_a_window_names_a_response_only_where_its_filter_takes_one() -> None:
    assert b"response_version" not in encode(window())
    named = decode(encode(window(response_version=0)))
    assert isinstance(named, WindowMessage)
    assert named.response_version == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate": 0.0}, "rate 0.0 Hz is not positive"),
        ({"modes": ((0.8, 0.6, 0.0, 0.0),)}, "must all decay"),
        ({"modes": ((0.8, 0.1, math.inf, 0.0),)}, "must be finite"),
        ({"static_gain": 0.0}, "static_gain 0 m/rad"),
        ({"unseen": -1.0}, "unseen -1.0 s"),
        ({"gap": -0.1}, "gap -0.1 rad"),
        ({"gap_std": math.inf}, "gap_std inf rad"),
    ],
)
def test_a_response_that_no_structure_has_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidMessage, match=words):
        msgspec.structs.replace(RESPONSE, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time": math.nan}, "time nan s is not finite"),
        ({"rate": 0.0}, "rate 0.0 Hz is not positive"),
        ({"setting": Setting(-1.0)}, "tolerance -1.0 m is not allowed"),
    ],
)
def test_a_hello_of_no_machine_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidMessage, match=words):
        msgspec.structs.replace(HELLO, **changes)


def test_a_window_has_an_identity() -> None:
    w = window()
    assert w.identity == ("axis-1", "b0", 4)
    assert w.samples == 3
    assert w.channel("theta_m") is w.channels[1]
    assert w.channel("voltage") is None


@given(st.lists(SAMPLES, min_size=1, max_size=60))
def test_quantisation_error_is_at_most_half_a_step(samples: list[float]) -> None:
    channel = pack_channel("x", "m", samples)
    rounding = 4 * max(math.ulp(x) for x in samples)
    back = unpack_channel(channel)
    assert all(abs(a - b) <= 0.5 * channel.scale * (1 + 1e-9) + rounding for a, b in zip(samples, back, strict=True))


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=60))
def test_the_whole_int16_range_is_used(samples: list[float]) -> None:
    channel = pack_channel("x", "m", samples)
    codes = array("h", channel.data)
    if max(samples) - min(samples) < 1e-250:
        return
    assert (min(codes), max(codes)) == (-32768, 32767)


def test_codes_are_little_endian() -> None:
    assert pack_channel("x", "m", [0.0, 65535.0, 32769.0]).data == b"\x00\x80\xff\x7f\x01\x00"


@pytest.mark.parametrize("value", [0.0, -3.7e-5, 1e300])
def test_constants_and_single_samples_are_exact(value: float) -> None:
    for count in (1, 7):
        channel = pack_channel("x", "m", [value] * count)
        assert channel.scale == 0.0
        assert list(unpack_channel(channel)) == [value] * count


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        ([], "no samples"),
        ([0.0, math.nan], "sample 1 is nan m"),
        ([math.inf, 0.0], "sample 0 is inf m"),
        ([-1e308, 1e308], "too large"),
    ],
)
def test_what_cannot_be_packed_is_named(samples: list[float], words: str) -> None:
    with pytest.raises(InvalidMessage, match=words):
        pack_channel("position", "m", samples)


@given(st.binary(max_size=300))
def test_garbage_is_refused_and_nothing_else(data: bytes) -> None:
    with pytest.raises(InvalidMessage):
        decode(data)


@dataclass
class Damage:
    position: float
    value: int
    cut: int


DAMAGE = st.builds(Damage, st.floats(0, 1, exclude_max=True), st.integers(0, 255), st.integers(0, 3))


@given(st.sampled_from(MESSAGES), st.lists(DAMAGE, min_size=1, max_size=6))
def test_damaged_messages_decode_or_are_refused(message: Message, damages: list[Damage]) -> None:
    data = bytearray(encode(message))
    for damage in damages:
        data[int(damage.position * len(data))] = damage.value
    try:
        result = decode(bytes(data[: len(data) - damages[0].cut]))
    except InvalidMessage:
        return
    assert isinstance(result, Message)


@given(st.recursive(st.none() | st.integers(-9, 9) | st.text(max_size=4), lambda x: st.lists(x, max_size=3)))
def test_foreign_objects_are_refused(thing: object) -> None:
    for tag in ("window/1", "update/1", "update/2", "receipt/1", "hello/1", "hello/2", "ack/1", "window/2"):
        with pytest.raises(InvalidMessage):
            decode(msgspec.msgpack.encode({"type": tag, "servo": thing}))


@pytest.mark.parametrize(
    "data", [b"\x91" * 100_000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"]
)
def test_bombs_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidMessage):
        decode(data)


def test_deep_nesting_in_an_ignored_field_is_refused() -> None:
    data = bytearray(encode(ACKNOWLEDGE))
    data[0] += 1
    data += b"\xa1x" + b"\x91" * 100_000 + b"\x01"
    with pytest.raises(InvalidMessage):
        decode(bytes(data))


def test_size_is_limited_before_parsing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "_decoder", None)
    with pytest.raises(InvalidMessage, match="at most 10 are allowed"):
        decode(b"x" * 11, limit=10)


@pytest.mark.parametrize("channel", [0, 1])
def test_the_checksum_covers_samples_and_scales(channel: int) -> None:
    good = window().channels[channel]
    flipped = bytes([good.data[0] ^ 1]) + good.data[1:]
    for change in ({"data": flipped}, {"scale": 1.0}, {"offset": 9.0}, {"name": "voltage"}, {"unit": "V"}):
        channels = list(window().channels)
        channels[channel] = msgspec.structs.replace(good, **change)
        with pytest.raises(InvalidMessage, match="checksum"):
            decode(encode(window(channels=tuple(channels))))


def test_every_single_bit_flip_in_the_samples_is_found() -> None:
    data = encode(window())
    start = data.index(window().channels[0].data)
    for position in range(start, start + 6):
        for bit in range(8):
            broken = bytearray(data)
            broken[position] ^= 1 << bit
            with pytest.raises(InvalidMessage, match="checksum"):
                decode(bytes(broken))


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": 0.0},
        {"rate": math.nan},
        {"start": math.inf},
        {"reference_changes": ((math.nan, 0.0),)},
        {"channels": (pack_channel("a", "m", [0.0]), pack_channel("b", "m", [0.0, 1.0]))},
        {"channels": (pack_channel("a", "m", [0.0]), pack_channel("a", "m", [0.0]))},
    ],
)
def test_inconsistent_windows_cannot_be_made(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidMessage):
        window(**changes)


@pytest.mark.parametrize(
    "changes",
    [{"servo": ""}, {"servo": "../x"}, {"servo": "a\n"}, {"sequence": -1}, {"crc": 2**32}, {"boot": "x" * 65}],
)
def test_fields_out_of_range_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidMessage):
        decode(encode(window(**changes)))


@pytest.mark.parametrize(
    "changes",
    [
        {"setting": Setting(-1e-9)},
        {"setting": Setting(math.nan)},
        {"gap": math.nan},
        {"interval": (0.0, math.inf)},
        {"not_after": math.inf},
        {"data_time": math.nan},
    ],
)
def test_updates_carry_finite_numbers_or_none(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidMessage):
        msgspec.structs.replace(UPDATE, **changes)


@pytest.mark.parametrize(
    ("part", "changes"),
    [
        ("gains", {"Kp": math.nan}),
        ("gains", {"Ki": math.inf}),
        ("gains", {"Tf": 0.0}),
        ("gains", {"enter": -0.1}),
        ("gains", {"enter": 2.0}),
        ("gains", {"feedforward": math.inf}),
        ("band", {"error": -1e-9}),
        ("band", {"error_rms": math.nan}),
        ("band", {"effort": math.inf}),
        ("band", {"settling": -1.0}),
    ],
)
def test_gains_and_bands_are_in_range_or_refused(part: str, changes: dict[str, float]) -> None:
    """Made here or decoded: what a constructor refuses is refused from the wire too."""
    with pytest.raises(InvalidMessage):
        msgspec.structs.replace(getattr(FULL_UPDATE.setting, part), **changes)
    raw = msgspec.msgpack.decode(encode(FULL_UPDATE))
    raw["setting"][part].update(changes)
    with pytest.raises(InvalidMessage, match=part):
        decode(msgspec.msgpack.encode(raw))


def test_an_update_without_gains_band_and_verification_does_not_mention_them() -> None:
    raw = msgspec.msgpack.decode(encode(UPDATE))
    assert set(raw) == {"type", *UPDATE.__struct_fields__} - {"verification", "needs"}
    assert raw["setting"] == {"tolerance": 1e-4}


def flat(message: Update | Fallback | Hello) -> dict[str, Any]:
    """The document that the version before wrote of a message."""
    document = msgspec.to_builtins(message)
    setting = document.pop("setting")
    document |= {"type": document["type"].replace("/2", "/1"), "tolerance": setting["tolerance"]}
    document |= {new: setting[old] for old, new in (("gains", "controller"), ("band", "band")) if old in setting}
    return document | ({"proof": document.pop("verification")} if "verification" in document else {})


@pytest.mark.parametrize("message", [UPDATE, FULL_UPDATE, FALLBACK, HELLO])
def test_messages_of_the_version_before_are_read(message: Update | Fallback | Hello) -> None:
    document = flat(message)
    assert decode(msgspec.msgpack.encode(document)) == message


def test_a_message_of_the_version_before_is_checked_like_a_new_one() -> None:
    with pytest.raises(InvalidMessage, match="tolerance"):
        decode(msgspec.msgpack.encode(flat(UPDATE) | {"tolerance": -1.0}))
    with pytest.raises(InvalidMessage, match="not understood"):
        decode(msgspec.msgpack.encode(flat(UPDATE) | {"more": bytes(MAX_LEGACY_BYTES)}))


def test_gains_of_the_version_before_open_the_loop_in_the_dead_zone() -> None:
    before = b'{"Kp":1.0,"Ki":2.0,"Kd":0.0,"Tf":0.1,"enter":0.5,"leave":1.5,"feedforward":0.0}'
    assert msgspec.json.decode(before, type=Gains) == Gains(1.0, 2.0, 0.0, 0.1, 0.5, 1.5)
    assert msgspec.json.decode(before, type=Gains).velocity_feedforward == 0.0
    assert msgspec.json.decode(before, type=Gains).friction_feedforward == 0.0
    assert msgspec.json.decode(before, type=Gains).notch_hz == 0.0


def test_an_unknown_schema_version_is_named() -> None:
    with pytest.raises(InvalidMessage, match="window/2"):
        decode(encode(window()).replace(b"window/1", b"window/2"))


def test_odd_channels_are_refused() -> None:
    for data in (b"", b"abc"):
        with pytest.raises(InvalidMessage, match="int16"):
            Channel("a", "m", 1.0, 0.0, data)


def test_unknown_values_are_none() -> None:
    assert messages.finite(math.nan) is None
    assert messages.finite(math.inf) is None
    assert messages.finite(0.25) == 0.25


@pytest.mark.parametrize(("name", "value"), [("tail", math.inf), ("Ms", math.nan), ("settled", 1.5)])
def test_a_verification_is_of_finite_numbers(name: str, value: float) -> None:
    with pytest.raises(InvalidMessage, match=f"verification {name}"):
        msgspec.structs.replace(VERIFICATION, **{name: value})
