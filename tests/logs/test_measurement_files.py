"""MDF, TDMS and MCAP: formats whose libraries come by extras."""

import struct

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.logs.mcap_file import joint_state
from servotwin.logs.own_times import TimedChannel, one_table
from servotwin.logs.recordings import RecordingColumns, read_recording


@pytest.fixture(scope="module")
def made():
    return recording(seconds=4.0, rate=100.0)


def cdr(stamp, names, *arrays, order="<"):
    """A JointState as ROS 2 writes it."""
    body = bytearray()

    def put(form, *values):
        size = struct.calcsize(form)
        body.extend(b"\0" * (-len(body) % size))
        body.extend(struct.pack(f"{order}{len(values)}{form}", *values))

    def text(value):
        put("I", len(value) + 1)
        body.extend(value.encode() + b"\0")

    put("i", int(stamp))
    put("I", round(1e9 * (stamp % 1.0)))
    text("base")
    put("I", len(names))
    for name in names:
        text(name)
    for values in arrays:
        put("I", len(values))
        if len(values):
            put("d", *values)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + bytes(body)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_joint_state_is_decoded_in_either_byte_order(order):
    state = joint_state(cdr(12.25, ("a", "elbow"), (1.5, -2.0), (), (0.25, 4.0), order=order))
    assert state.stamp == pytest.approx(12.25)
    assert state.names == ("a", "elbow")
    assert [list(each) for each in state[2:]] == [[1.5, -2.0], [], [0.25, 4.0]]


def test_a_joint_state_that_is_cut_off_is_refused():
    whole = cdr(1.0, ("a",), (1.0,), (2.0,), (3.0,))
    for size in range(4, len(whole)):
        with pytest.raises(ValueError, match="ends too early"):
            joint_state(whole[:size])


def test_a_wrapped_angle_and_times_that_go_back_give_no_values_between():
    slow = np.arange(0.0, 8.0, 0.5)
    angle = np.mod(1.0 + 2.0 * slow, 2.0 * np.pi)
    back = np.insert(slow, 6, 0.1)
    channels = {
        "fast": TimedChannel(np.arange(0.0, 7.4, 0.01), np.zeros(740)),
        "slow": TimedChannel(back, np.insert(angle, 6, 99.0)),
    }
    found = one_table(("fast", "slow"), ("fast", "slow"), channels.__getitem__).values["slow"]
    # The nearest sample is half an interval away at most, in which the angle turns by 0.5.
    wrong = np.unwrap(found) - (1.0 + 2.0 * channels["fast"].time)
    assert np.abs(wrong).max() <= 0.5 + 1e-9
    assert np.median(np.abs(wrong)) < 1e-9


def test_channels_come_to_the_times_of_the_longest():
    channels = {
        "fast": TimedChannel(np.arange(5.0), np.arange(5.0) ** 2),
        "slow": TimedChannel(np.array([1.0, 3.0]), np.array([10.0, 30.0])),
        "other": TimedChannel(np.arange(99.0), np.zeros(99)),
    }
    table = one_table(tuple(channels), ("fast", "slow", "time [s]"), channels.__getitem__)
    assert list(table.values["time [s]"]) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert list(table.values["slow"][1:4]) == [10.0, 20.0, 30.0]
    assert np.isnan(table.values["slow"][[0, 4]]).all()
    assert table.names == ("time [s]", "fast", "slow", "other")


def seen(path, made, **columns):
    log = read_recording(path, RecordingColumns(**columns))
    assert log.recording.time.size == made.time.size
    assert np.allclose(log.recording.motor, made.motor, atol=1e-8)
    assert np.allclose(log.recording.load, made.load, atol=1e-8)
    assert np.allclose(np.diff(log.recording.time), np.diff(made.time))
    return log.recording


def test_an_mdf_file_is_read_with_its_units(made, tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is an extra: pip install 'servotwin[mdf]'")
    file = asammdf.MDF(version="4.10")
    file.append([asammdf.Signal(made.motor, made.time, unit="rad", name="motor")])
    file.append([asammdf.Signal(made.load, made.time, unit="mm", name="load")])
    path = tmp_path / "log.mf4"
    file.save(path)
    found = seen(path, made)
    assert (found.motor_unit, found.load_unit) == ("rad", "mm")


def test_a_tdms_file_is_read_with_its_units(made, tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is an extra: pip install 'servotwin[tdms]'")
    path = tmp_path / "log.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        for name, values, unit in (("motor", made.motor, "rad"), ("load", made.load, "mm")):
            properties = {"wf_increment": 0.01, "wf_start_offset": 0.0, "unit_string": unit}
            writer.write_segment([nptdms.ChannelObject("Rig", name, values, properties)])
    found = seen(path, made)
    assert (found.motor_unit, found.load_unit) == ("rad", "mm")


def test_a_bag_of_ros_is_read(made, tmp_path):
    writing = pytest.importorskip("mcap.writer", reason="mcap is an extra: pip install 'servotwin[mcap]'")
    path = tmp_path / "bag.mcap"
    with path.open("wb") as opened:
        writer = writing.Writer(opened)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for time, *angles in zip(made.time, made.motor, made.load, strict=True):
            data = cdr(1e6 + time, ("drive", "arm"), angles, (), ())
            # The recording takes messages late, and in one go where it was busy.
            late = round(1e9 * np.ceil(4.0 * time) / 4.0)
            writer.add_message(channel, log_time=late, publish_time=0, data=data)
        writer.finish()
    seen(path, made, motor="drive.position", load="arm.position")


@pytest.mark.parametrize(("suffix", "library"), [("mf4", "asammdf"), ("tdms", "nptdms"), ("mcap", "mcap")])
def test_a_damaged_file_or_a_missing_library_is_said_in_a_sentence(suffix, library, tmp_path):
    path = tmp_path / f"log.{suffix}"
    path.write_bytes(b"no such file " * 40)
    with pytest.raises(InvalidInput, match=rf"log .*log\.{suffix}: (is not an? .* file that can be read|.*{library})"):
        read_recording(path, RecordingColumns())
