"""What the twin may set of each kind of law: it crosses the link, and the law that runs is the one that was meant."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.config.table import parse_toml
from servotwin.config.toml import dumps
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of, has_gains, holds, read_gains, with_gains, written_gains
from servotwin.control.laws import AnyController
from servotwin.control.retuning import integrates, scaled, static_gain, without_integral
from servotwin.control.running_law import RunningLaw, command_of
from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains, Setting

PID = Controller(4e3, 1e3, 90.0, 0.02, sample_rate=1e3)
CASCADE = Cascade(20.0, 0.1, velocity_gain=3.0, integral_time=0.07, notch_hz=40.0, sample_rate=1e3, voltage_limit=50.0)
LINEAR = CASCADE.linear()
LAWS: tuple[AnyController, ...] = (PID, CASCADE, LINEAR, CASCADE.replace(integral_time=None, notch_hz=None))
POSITIVE = st.floats(0.2, 5.0)
SHARES = st.just(0.0) | st.floats(1e-3, 2.0)


@pytest.mark.parametrize("law", LAWS, ids=["pid", "cascade", "linear", "no integral"])
@given(scale=POSITIVE, share=SHARES, lead=st.floats(1.0, 2.0), fed=st.floats(-1.0, 1.0))
def test_gains_that_were_encoded_make_the_very_law_that_was_verified(
    law: AnyController, scale: float, share: float, lead: float, fed: float
) -> None:
    verified = scaled(law, scale, (lead, 0.7), share).replace(feedforward=fed, enter=0.3, leave=1.7)
    setting = Setting.of(1e-4, gains_of(verified))
    received = msgspec.msgpack.decode(msgspec.msgpack.encode(setting), type=Setting)
    assert received == setting
    assert with_gains(law, received.gains) == verified


def test_settings_of_the_filtered_pid_keep_their_bytes() -> None:
    written = b'{"tolerance":0.001,"gains":{"Kp":1.0,"Ki":2.0,"Kd":3.0,"Tf":4.0'
    assert msgspec.json.encode(Setting.of(1e-3, Gains(1.0, 2.0, 3.0, 4.0))).startswith(written)
    assert b"law" not in msgspec.json.encode(Setting.of(1e-3, Gains(1.0, 2.0, 3.0, 4.0)))
    assert msgspec.json.decode(b'{"tolerance":0.001}', type=Setting) == Setting.of(1e-3)


def test_a_setting_has_the_gains_of_one_law_only() -> None:
    with pytest.raises(msgspec.ValidationError, match="only one of them"):
        msgspec.json.decode(
            b'{"tolerance":0.1,"gains":{"Kp":1,"Ki":0,"Kd":0,"Tf":1},"law":{"type":"linear"}}', type=Setting
        )


@pytest.mark.parametrize("text", [b'{"type":"cascade","position_gain":-1}', b'{"type":"linear","gain":0}'])
def test_gains_out_of_their_range_are_no_message(text: bytes) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"is negative|is not positive"):
        msgspec.json.decode(b'{"tolerance":0.1,"law":' + text + b"}", type=Setting)


@pytest.mark.parametrize(
    ("law", "gains"),
    [
        (PID, LinearGains()),
        (CASCADE, Gains(1.0, 0.0, 0.0, 1.0)),
        (CASCADE, CascadeGains(1.0)),
        (LINEAR, gains_of(CASCADE)),
    ],
)
def test_gains_of_another_law_are_refused(law: AnyController, gains: AnyGains) -> None:
    with pytest.raises(InvalidInput, match="must be those of a"):
        with_gains(law, gains)


def test_a_cascade_cannot_hold_an_integral_without_a_velocity_loop_nor_a_notch_beyond_its_rate() -> None:
    with pytest.raises(msgspec.ValidationError, match=r"integral_time 0\.5 needs a velocity_gain"):
        msgspec.json.decode(b'{"type":"cascade","position_gain":1,"integral_time":0.5}', type=CascadeGains)
    gains = gains_of(CASCADE)
    assert holds(CASCADE, gains)
    assert not holds(CASCADE, msgspec.structs.replace(gains, notch_hz=500.0))


def test_gains_of_a_cascade_alone_are_refused() -> None:
    with pytest.raises(InvalidInput, match="with the law that they belong to"):
        written_gains(gains_of(CASCADE))


def test_gains_of_a_linear_law_read_back_as_they_were_written() -> None:
    """An edge whose fallback set is not its own law could not be enrolled."""
    gains = LinearGains(gain=0.6, integral_share=0.0, enter=0.5, leave=1.5, feedforward=0.25, integral_only=False)
    table = parse_toml(dumps(written_gains(gains, LINEAR)), "edge.toml")
    assert has_gains(table, type(LINEAR))
    assert read_gains(table, LINEAR) == gains
    table.done()


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_one_factor_scales_a_cascade_and_its_linear_law_alike(share: float) -> None:
    """The same ticks to rounding, in other states."""
    plain = CASCADE.replace(voltage_limit=None)
    laws = [RunningLaw(scaled(law, 0.6, (1.0, 1.0), share), 0.0) for law in (plain, plain.linear())]
    states = [law.start(0.0, 0.0) for law in laws]
    for k in range(200):
        sample = (0.01, 0.05 * (k / 200) ** 2, 4e-3 * k / 200)
        states = [law.tick(state, *sample) for law, state in zip(laws, states, strict=True)]
        assert command_of(states[0]) == pytest.approx(command_of(states[1]), rel=1e-9)


def test_answer_and_integral_action_are_those_of_the_law() -> None:
    assert static_gain(PID) == 4e3
    assert static_gain(CASCADE) == pytest.approx(600.0)
    assert static_gain(LINEAR) == pytest.approx(600.0)
    assert static_gain(LINEAR.replace(gain=0.5)) == pytest.approx(300.0)
    assert all(integrates(law) for law in LAWS[:3])
    assert not any(integrates(without_integral(law)) for law in LAWS)


@pytest.mark.parametrize("old", LAWS[:3], ids=["pid", "cascade", "linear"])
@given(scale=POSITIVE, share=SHARES, tolerance=st.floats(0.0, 1e-3), fed=st.floats(-1.0, 1.0))
def test_a_change_of_gains_leaves_the_command_where_it_is(
    old: AnyController, scale: float, share: float, tolerance: float, fed: float
) -> None:
    before, after = (
        RunningLaw(old, 1e-4),
        RunningLaw(scaled(old, scale, (1.0, 1.0), share).replace(feedforward=fed), tolerance),
    )
    state = before.start(0.0, 0.0)
    for k in range(50):
        state = before.tick(state, 2e-3, 1e-3 * k, 1e-4 * k)
    sample = (2e-3, 5e-3, 5e-4)
    wanted = command_of(before.tick(state, *sample))
    moved = after.tick(after.take_over(before, state, *sample), *sample)
    assert abs(command_of(moved) - wanted) <= 1e-12 * max(1.0, abs(wanted), static_gain(old) * 1e-2)


def test_what_an_integral_held_fades_where_the_new_law_has_none() -> None:
    """At zero error the command of the law without integral action ends at zero."""
    for own in (CASCADE, LINEAR):
        before, after = RunningLaw(own), RunningLaw(without_integral(own))
        state = before.start(0.0, 0.0)
        for _ in range(100):
            state = before.tick(state, 1e-2, 0.0, 0.0)
        state = after.take_over(before, state, 0.0, 0.0, 0.0)
        assert abs(command_of(after.tick(state, 0.0, 0.0, 0.0))) > 0.1
        for _ in range(10_000):
            state = after.tick(state, 0.0, 0.0, 0.0)
        assert command_of(state) == pytest.approx(0.0, abs=1e-6)
